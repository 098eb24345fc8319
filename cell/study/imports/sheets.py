"""Sheets of workbooks, tables of databases: the cable's points, its gripper, or trials."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import reduce
from pathlib import Path

from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, is_clock, is_number, number
from cell.study.imports.contents import contents
from cell.study.imports.delimited import captured
from cell.study.imports.groups import FilePart, with_part
from cell.study.imports.header import read_header
from cell.study.imports.long_tables import joined, pivoted, same_frames, time_column
from cell.study.imports.other_kinds import BAG_TABLES, bag_error
from cell.study.imports.side_by_side import (
    CELL,
    blocks,
    cable_and_gripper,
    column_letters,
    have_own_times,
    of_block,
)
from cell.study.imports.text_content import is_text
from cell.study.imports.text_rows import DECIMALS, Row, without_summary
from cell.study.imports.units import METRES, split_unit

#: Maximum number of rows above a sheet's table.
_MAX_HEADER = 200
#: Endings of names of databases, and of all files with sheets.
_DATABASES = (".db", ".db3", ".sqlite", ".sqlite3")
WITH_SHEETS = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods", *_DATABASES)


def has_sheets(path: Path) -> bool:
    """Whether a file is a workbook or a database by its name; a text may be called .xls, too."""
    ending = path.suffix.lower()
    return ending in WITH_SHEETS and not (ending == ".xls" and is_text(path))


def read_sheet(path: Path, title: str) -> Capture:
    """Read a sheet; without a title the first one with the largest number of points.

    raises  InputError: it holds no table, or none does
    """
    tables = _sheets(path)
    if title and title not in tables:
        raise InputError.at(path, f"has no sheet {title!r} with a table; correct its name")
    best = title or _with_most_points(tables)
    skipped = ", ".join(repr(name) for name in tables if name != best)
    note = f"{path}: sheet {best!r} is read, not {skipped}"
    table = tables[best].noted(note) if skipped and not title else tables[best]
    return replace(table, path=with_part(path, title))


def _with_most_points(tables: Mapping[str, Capture]) -> str:
    return max(tables, key=lambda title: len(contents(tables[title]).points))


def _sheets(path: Path) -> dict[str, Capture]:
    """Every sheet that holds a table, by its title.  Raises InputError: none does."""
    tables: dict[str, Capture] = {}
    problems: list[InputError] = []
    of_cable: tuple[tuple[str, float], ...] = ()
    pages = _tables_of_database if path.suffix.lower() in _DATABASES else _pages_of_workbook
    for title, page in pages(path):
        rows = [Row(i, tuple(cells)) for i, cells in enumerate(_texts(list(page)), 1)]
        of_cable = of_cable or _stated_length(rows[:_MAX_HEADER])
        rows = [row for row in rows if not row.blank]
        try:
            if adjacent := _adjacent_tables(path, title, rows):
                tables |= adjacent
            elif (capture := _table_of(path, rows)) is not None:
                tables[title] = capture
        except InputError as error:
            problems.append(error)
    if problems and not tables:
        raise problems[0]
    if not tables:
        message = "no sheet holds rows of numbers; give a line of names above them"
        raise InputError.at(path, message)
    joint = _with_axes_joined(tables)
    return {title: replace(table, of_cable=of_cable) for title, table in joint.items()}


def _adjacent_tables(path: Path, title: str, rows: Sequence[Row]) -> dict[str, Capture]:
    """Tables of a sheet side by side, each with times of its own; empty = they are one."""
    tables: dict[str, Capture] = {}
    for block in blocks(rows):
        try:
            capture = _table_of(path, of_block(rows, block))
        except InputError:
            return {}
        if capture is not None:
            tables[f"{title}{CELL}{column_letters(block[0])}"] = capture
    return tables if have_own_times(list(tables.values())) else {}


def _with_axes_joined(tables: Mapping[str, Capture]) -> Mapping[str, Capture]:
    """One table of sheets that are called x, y and perhaps z, with equal columns and times; columns
    of the other sheets with these times are joined to it.  Else unchanged.
    """
    axes = [title for title in tables if title.lower() in ("x", "y", "z")]
    alike = len({tables[title].names for title in axes}) == 1 < len(axes)
    if not alike or not all(same_frames(tables[axes[0]], tables[title]) for title in axes):
        return tables
    others = [t for t in tables if t not in axes and same_frames(tables[axes[0]], tables[t])]
    parts = [_titled(tables[title], title) for title in (*axes, *others)]
    return {t: table for t, table in tables.items() if t not in (*axes, *others)} | {
        axes[0]: reduce(joined, parts)
    }


def _titled(table: Capture, title: str) -> Capture:
    """A table with its title behind the names of its columns, except that of times."""
    time, columns = time_column(table), list(table.columns)
    for i, column in enumerate(columns):
        bare, unit = split_unit(column.name)
        columns[i] = column if i == time else replace(
            column, name=f"{bare} {title}", unit=column.unit or unit
        )  # fmt: skip
    return replace(table, columns=tuple(columns))


def _texts(page: Sequence[Sequence[object]]) -> Iterator[list[str]]:
    """Cells of each row as text; numbers that are texts have one decimal mark, as in a CSV."""
    texts = [c for cells in page[:_MAX_HEADER] for c in cells if isinstance(c, str)]
    point, comma = (sum(is_number(text, mark) for text in texts) for mark in DECIMALS)
    for cells in page:
        yield [_with_point(c) if comma > point else c for c in map(cell_text, cells)]


def _with_point(cell: str) -> str:
    """A cell with a point for the decimal comma of a number."""
    is_one = "," in cell and is_number(cell, ",") and not is_clock(cell)
    return repr(number(cell, ",")) if is_one else cell


def _pages_of_workbook(path: Path) -> Iterator[tuple[str, Iterable[Sequence[object]]]]:
    """Title and rows of each sheet of a workbook."""
    from python_calamine import CalamineWorkbook

    with CalamineWorkbook.from_path(path) as book:
        for title in book.sheet_names:
            yield title, book.get_sheet_by_name(title).to_python(skip_empty_area=False)


def _tables_of_database(path: Path) -> Iterator[tuple[str, Iterable[Sequence[object]]]]:
    """Name of each table of an SQLite database, and its rows below the names of its columns.

    raises  InputError: it is a recording of rosbag2
    """
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
        names = database.execute("SELECT name FROM sqlite_master WHERE type IN ('table', 'view')")
        titles = [name for (name,) in names.fetchall()]
        if set(titles) >= BAG_TABLES:
            raise bag_error(path)
        for name in titles:
            rows = database.execute('SELECT * FROM "{}"'.format(name.replace('"', '""')))
            yield name, [[c[0] for c in rows.description], *rows.fetchall()]


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
    """Sheets with points, if all have the same columns and there are several; or one with the
    cable's points, and one with its gripper alone; or sheets that have both side by side; else
    empty.
    """
    sheets = _sheets(path)
    pages: dict[str, dict[str, Capture]] = {}
    for title, table in sheets.items():
        pages.setdefault(title.rpartition(CELL)[0], {})[title] = table
    pairs = {page: cable_and_gripper(tables) for page, tables in pages.items() if page}
    if pairs and all(pairs.values()):
        return [FilePart(page if len(pairs) > 1 else "", *p) for page, p in pairs.items() if p]
    tables = {title: t for title, t in sheets.items() if contents(t).points}
    if len({t.names for t in tables.values()}) == 1 and len(tables) > 1:
        return [FilePart(title, title) for title in tables]
    pair = cable_and_gripper(sheets)
    named = pair is not None and any(p.on_gripper for p in contents(sheets[pair[0]]).points)
    return [FilePart("", *pair)] if pair and not named else []


def _table_of(path: Path, rows: Sequence[Row]) -> Capture | None:
    """Table from the first row with two numbers, and at least as many numbers as words."""
    numbers = [sum(is_number(cell, ".") for cell in row.cells) for row in rows[:_MAX_HEADER]]
    tables = (i for i, count in enumerate(numbers) if count >= 2 and rows[i].is_data("."))
    if (first := next(tables, None)) is None:
        return None
    filled = [i for i, cell in enumerate(rows[first].cells) if cell]
    begin, end = filled[0], filled[-1] + 1
    for row in rows[:first]:
        named = [i for i, cell in enumerate(row.cells) if cell]
        if len(named) > 2:
            begin, end = min(begin, named[0]), max(end, named[-1] + 1)
    above = [(row.line, row.cells[begin:end]) for row in rows[:first]]
    table = [Row(row.line, row.cells[begin:end]) for row in rows[first:]]
    table, below = without_summary(path, table, ".")
    header = read_header(path, above, table[0].cells)
    capture, labels = captured(path, header, table, ".")
    return pivoted(replace(capture, notes=(*capture.notes, *below)), labels)


def cell_text(cell: object) -> str:
    """A cell as text for `number`; a whole number without decimals, as labels are."""
    if cell is None:
        return ""
    whole = isinstance(cell, bool) or (isinstance(cell, float) and cell.is_integer())
    return str(int(cell)) if whole else str(cell).strip()  # type: ignore[call-overload]
