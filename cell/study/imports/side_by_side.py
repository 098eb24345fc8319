"""Tables side by side, between them an empty column: of the cable, and of its gripper."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, TextForm
from cell.study.imports.contents import Contents, contents
from cell.study.imports.delimited import read_text
from cell.study.imports.groups import FilePart, with_part
from cell.study.imports.long_tables import same_frames
from cell.study.imports.text_content import head_of, text_of
from cell.study.imports.text_rows import Row, split_lines, text_form

#: Mark between a sheet and the first column of one of its tables, as in `Test 1!J`.
CELL = "!"
#: A row of fewer cells is a title, which may stand above several tables.
_FEWEST_CELLS = 3


def blocks(rows: Sequence[Row]) -> list[tuple[int, int]]:
    """First column of each table, and the one behind its last; empty = the rows are one table."""
    wide = [row.cells for row in rows if sum(map(bool, row.cells)) >= _FEWEST_CELLS]
    width = max(map(len, wide), default=0)
    filled = [any(c < len(cells) and cells[c].strip() for cells in wide) for c in range(width)]
    begins = [c for c in range(width) if filled[c] and not (c and filled[c - 1])]
    ends = [c + 1 for c in range(width) if filled[c] and not (c + 1 < width and filled[c + 1])]
    found = list(zip(begins, ends, strict=True))
    return found if len(found) > 1 and all(end - begin > 1 for begin, end in found) else []


def of_block(rows: Sequence[Row], block: tuple[int, int]) -> list[Row]:
    """The rows with the cells of one table."""
    cut = (Row(row.line, row.cells[slice(*block)]) for row in rows)
    return [row for row in cut if not row.blank]


def column_letters(index: int) -> str:
    """Name of a column, counted from 0, as spreadsheets have it: A … Z, AA …"""
    letters = ""
    while index >= 0:
        letters, index = chr(ord("A") + index % 26) + letters, index // 26 - 1
    return letters


def have_own_times(tables: Sequence[Capture]) -> bool:
    """Whether there are several tables, each with times, which are not all the same."""
    timed = len(tables) > 1 and all(contents(table).time is not None for table in tables)
    return timed and not all(same_frames(tables[0], table) for table in tables[1:])


def cable_and_gripper(tables: Mapping[str, Capture]) -> tuple[str, str] | None:
    """Titles of the table with the cable's points, and of the only one that is a gripper's."""
    inside = {title: contents(table) for title, table in tables.items()}
    cable = max(inside, key=lambda title: len(inside[title].points))
    hands = [title for title in inside if title != cable and is_of_gripper(inside[title])]
    return (cable, hands[0]) if len(hands) == 1 and not is_of_gripper(inside[cable]) else None


def is_of_gripper(inside: Contents) -> bool:
    """Whether a table shows nothing else than a gripper can: one point, or its sensor."""
    timed = inside.time is not None
    return timed and (len(inside.points) == 1 or (not inside.points and inside.has_gripper_sensor))


def parts_of_text(path: Path) -> list[FilePart]:
    """The cable's and the gripper's table of a text, if these stand side by side; else empty.

    The name of a part is the letters of its first column.
    """
    tables: dict[str, Capture] = {}
    try:
        for name in _tables(path):
            tables[name] = read_block(path, name, None)
    except InputError:  # it is read as one table
        return []
    pair = cable_and_gripper(tables) if have_own_times(list(tables.values())) else None
    return [FilePart("", *pair)] if pair else []


def read_block(path: Path, part: str, form: TextForm | None) -> Capture:
    """Read one of the tables of a text.  Raises InputError: it has no such table, or it is wrong.

    form  None = detected from the text
    """
    tables = _tables(path)
    if part not in tables:
        raise InputError.at(path, f"has no table in column {part}; it has {', '.join(tables)}")
    return read_text(with_part(path, part), tables[part], form)


def _tables(path: Path) -> dict[str, str]:
    """Texts of the tables of a text, by the letters of their first columns."""
    head = head_of(path).rpartition("\n")[0]
    separator = text_form(head).separator
    if separator == " " or not blocks(split_lines(path, head.splitlines(), separator)):
        return {}
    rows = split_lines(path, text_of(path)[0].splitlines(), separator)
    tables: dict[str, str] = {}
    for block in blocks(rows):
        lines = io.StringIO()
        writer = csv.writer(lines, delimiter=separator, lineterminator="\n")
        last = max(row.line for row in of_block(rows, block))
        writer.writerows(row.cells[slice(*block)] for row in rows if row.line <= last)
        tables[column_letters(block[0])] = lines.getvalue()
    return tables
