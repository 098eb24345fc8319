"""The page on architecture: its layers, and its walks, whose stops are there."""

from __future__ import annotations

import ast
import re
import tomllib
from itertools import groupby
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_STOP = re.compile(r"\| `([\w/]+\.py)` \| `([\w.]+)` \|")


def walks() -> dict[str, list[tuple[str, str]]]:
    """File and function of every stop, by the walk's heading."""
    page = (ROOT / "docs" / "explain" / "architecture.md").read_text(encoding="utf-8")
    parts = page.split("\n### ")[1:]
    return {part.splitlines()[0]: _STOP.findall(part) for part in parts}


def defined_in(path: Path) -> set[str]:
    """Functions, and methods as Class.method."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            inside = (n for n in node.body if isinstance(n, ast.FunctionDef))
            found |= {f"{node.name}.{n.name}" for n in inside}
    return found


def test_a_frame_ei_and_an_offset_are_walked() -> None:
    found = walks()
    assert [name.split(",")[0].split(":")[0] for name in found] == [
        "A frame",
        "EI",
        "EI",
        "An offset",
    ]
    assert all(len(stops) >= 8 for stops in found.values())


@pytest.mark.parametrize("walk", walks())
def test_every_stop_is_where_the_page_says(walk: str) -> None:
    for file, function in walks()[walk]:
        assert function in defined_in(ROOT / file), f"{function} is not in {file}"


@pytest.mark.parametrize("walk", walks())
def test_a_room_that_was_left_is_not_entered_again(walk: str) -> None:
    rooms = [str(Path(file).parent) for file, _ in walks()[walk]]
    entered = [room for room, _ in groupby(r for r in rooms if r not in ("cell", "cell/run"))]
    assert len(entered) == len(set(entered)), entered


def test_the_drawing_has_the_layers_that_imports_obey() -> None:
    page = (ROOT / "docs" / "explain" / "architecture.md").read_text(encoding="utf-8")
    drawing = page.partition("\n## Layers")[2].partition("\n    (below all")[0]
    drawn = re.findall(r"^    ([\w, ]+)$", drawing, re.MULTILINE)
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    (rooms,) = (c for c in contracts["contracts"] if c.get("containers") == ["cell"])
    assert drawn == [layer.replace(" | ", ", ") for layer in rooms["layers"][1:]]
