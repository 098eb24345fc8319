"""Spreadsheets (.xlsx): the sheet with the cable's points, or sheets that are trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, is_number, number
from cell.study.imports.contents import contents
from cell.study.imports.delimited import captured
from cell.study.imports.groups import FilePart, with_part
from cell.study.imports.header import read_header
from cell.study.imports.long_tables import pivoted
from cell.study.imports.text_rows import Row, without_summary
from cell.study.imports.units import METRES, split_unit

#: Maximum number of rows above a sheet's table.
_MAX_HEADER = 200


def read_sheet(path: Path, title: str) -> Capture:
    """Read a sheet; without a title the first one with the largest number of points.

    raises  InputError: it holds no table, or none does
    """
    tables = _sheets(path)
    if title and title not in tables:
        raise InputError.at(path, f"has no sheet {title!r} with a table; correct its name")
    best = title or max(tables, key=lambda name: len(contents(tables[name]).points))
    skipped = ", ".join(repr(name) for name in tables if name != best)
    note = f"{path}: sheet {best!r} is read, not {skipped}"
    if title:
        note = f"{path}: sheet {title!r} is read as a trial of its own, as are those like it"
    notes = (*tables[best].notes, note) if skipped else tables[best].notes
    return replace(tables[best], path=with_part(path, title), notes=notes)


def _sheets(path: Path) -> dict[str, Capture]:
    """Every sheet that holds a table, by its title.  Raises InputError: none does."""
    from openpyxl import load_workbook

    book = load_workbook(path, read_only=True, data_only=True)
    tables: dict[str, Capture] = {}
    problems: list[InputError] = []
    of_cable: tuple[tuple[str, float], ...] = ()
    try:
        for page in book.worksheets:
            lines = enumerate(page.iter_rows(values_only=True), 1)
            rows = [Row(line, tuple(cell_text(cell) for cell in cells)) for line, cells in lines]
            of_cable = of_cable or _stated_length(rows[:_MAX_HEADER])
            try:
                capture = _table_of(path, [row for row in rows if not row.blank])
            except InputError as error:
                problems.append(error)
                continue
            tables |= {} if capture is None else {page.title: capture}
    finally:
        book.close()
    if problems and not tables:
        raise problems[0]
    if not tables:
        message = "no sheet holds rows of numbers; give a line of names above them"
        raise InputError.at(path, message)
    return {title: replace(table, of_cable=of_cable) for title, table in tables.items()}


def _stated_length(rows: Sequence[Row]) -> tuple[tuple[str, float], ...]:
    """The cable's free length, m, where a row has its name with a unit, and a number."""
    for row in rows:
        name, value = [*(c for c in row.cells if c), "", ""][:2]
        bare, unit = split_unit(name)
        length = number(value, ".") or 0.0
        if bare.lower() == "free length" and unit in METRES and length > 0.0:
            return (("free_length_m", METRES[unit] * length),)
    return ()


def trials_in_sheets(path: Path) -> list[FilePart]:
    """Sheets with points, if all have the same columns and there are several; else empty."""
    tables = {title: t for title, t in _sheets(path).items() if contents(t).points}
    equal_columns = len({t.names for t in tables.values()}) == 1 and len(tables) > 1
    return [FilePart(title, title) for title in tables] if equal_columns else []


def _table_of(path: Path, rows: Sequence[Row]) -> Capture | None:
    """Table from the first row with two numbers, and at least as many numbers as words."""
    first = next((i for i, row in enumerate(rows[:_MAX_HEADER]) if _begins_table(row)), None)
    if first is None:
        return None
    width = max(i for i, cell in enumerate(rows[first].cells, 1) if cell)
    for row in rows[:first]:
        named = [i for i, cell in enumerate(row.cells, 1) if cell]
        width = max(width, len(named) if len(named) > 2 else 0)
    above = [(row.line, row.cells[:width]) for row in rows[:first]]
    table = [Row(row.line, row.cells[:width]) for row in rows[first:]]
    table, below = without_summary(path, table, ".")
    header = read_header(path, above, table[0].cells)
    capture, labels = captured(path, header, table, ".")
    return pivoted(replace(capture, notes=(*capture.notes, *below)), labels)


def _begins_table(row: Row) -> bool:
    return row.is_data(".") and sum(is_number(cell, ".") for cell in row.cells) >= 2


def cell_text(cell: object) -> str:
    """A cell as text for `number`."""
    if cell is None:
        return ""
    return str(int(cell)) if isinstance(cell, bool) else str(cell).strip()
