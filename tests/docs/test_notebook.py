"""The notebook of the docs runs from top to bottom, and shows what it says."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "docs" / "start" / "notebook.ipynb"


def test_every_cell_of_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cells = [c for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"]
    names: dict[str, object] = {"__name__": "notebook"}
    compared = 0
    for cell in cells:
        source = "".join(cell["source"])
        *before, last = ast.parse(source).body
        exec(compile(ast.Module(before, []), str(NOTEBOOK), "exec"), names)
        if not isinstance(last, ast.Expr):
            exec(compile(ast.Module([last], []), str(NOTEBOOK), "exec"), names)
            continue
        shown = eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names)
        stored = [o for o in cell["outputs"] if o["output_type"] == "execute_result"]
        assert ["text/html" in o["data"] for o in stored] == [hasattr(shown, "_repr_html_")]
        if isinstance(shown, str):
            assert "".join(stored[0]["data"]["text/plain"]) == repr(shown)
            compared += 1
    assert compared
    assert names["found"].effect == "tip_mass"  # type: ignore[attr-defined]
