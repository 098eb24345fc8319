"""What the page names is there, and means what it says there."""

from __future__ import annotations

import re
from pathlib import Path

from cell.plant.opcua.commands import COMMANDS
from cell.plant.opcua.unit import tags_of

PAGE = Path(__file__).parents[4] / "docs" / "plant.md"


def test_nodes_and_methods_of_the_page_are_there() -> None:
    text = PAGE.read_text(encoding="utf-8").partition("## OPC UA")[2].partition("\n## ")[0]
    tables = re.split(r"\n\| method ", text)
    nodes, methods = [re.findall(r"^\| `([\w.]+)` ", table, re.M) for table in tables]
    assert len(nodes) > 10
    assert set(nodes) <= {t.path for t in tags_of("line", None)}
    assert set(methods) <= {f"{c.path}.{c.name}" for c in COMMANDS}
