"""Tables of docs are short, and those said to be from a CSV file of measurements are in it."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
MEASURED = sorted((DOCS / "measured").glob("*.csv"))
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page.parent.name != "decisions"]
LONGEST_CELL = 60
#: Pages with tables that are still to be shortened.
STILL_LONG = {}
_FROM = re.compile(r"<!-- from: (\S+) -->")


def cells(line: str) -> list[str]:
    """Of a row, with what a link shows in place of the link."""
    shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line)
    return [cell.strip() for cell in shown.strip().strip("|").split("|")]


def tables(page: str) -> Iterator[tuple[str, list[list[str]]]]:
    """The file that each table is said to be from, "" if it is not; its head and rows."""
    source, rows = "", list[list[str]]()
    for line in [*page.splitlines(), ""]:
        if line.startswith("|"):
            if not re.fullmatch(r"[|\s:-]+", line):
                rows.append(cells(line))
        elif rows:
            yield source, rows
            source, rows = "", []
        elif said := _FROM.fullmatch(line):
            source = said[1]
        elif line.strip():
            source = ""


def read(path: Path) -> list[list[str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file, strict=True))


def long_cells(page: Path) -> list[str]:
    found = (c for _, rows in tables(page.read_text(encoding="utf-8")) for row in rows for c in row)
    return [cell for cell in found if len(cell) > LONGEST_CELL]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_no_cell_of_a_table_is_long(page: Path) -> None:
    if page.name in STILL_LONG:
        assert long_cells(page), f"{page.name} has no long cells any more: take it off the list"
    else:
        assert not long_cells(page)


@pytest.mark.parametrize("path", MEASURED, ids=lambda p: p.name)
def test_a_csv_file_of_measurements_has_as_many_cells_in_every_row(path: Path) -> None:
    head, *rows = read(path)
    assert rows
    assert len(set(head)) == len(head)
    assert {len(row) for row in rows} == {len(head)}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_tables_show_what_their_csv_file_says(page: Path) -> None:
    for source, (shown, *rows) in tables(page.read_text(encoding="utf-8")):
        if not source:
            continue
        head, *measured = read(DOCS / source)
        columns = [head.index(name) for name in shown]
        there = {tuple(row[i] for i in columns) for row in measured}
        assert [row for row in rows if tuple(row) not in there] == [], f"not in {source}"


def test_tables_are_found_with_their_sources() -> None:
    page = "<!-- from: a.csv -->\n\n| a | b |\n|---|---|\n| [1](x) | |\n\nText\n\n| c |\n|---|\n"
    assert list(tables(page)) == [("a.csv", [["a", "b"], ["1", ""]]), ("", [["c"]])]
