"""Lines above a table: column names over one or more lines or in a list, units, rate, remarks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from cell.files.input_error import InputError
from cell.study.imports.capture import CapturedColumn, is_number, number
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.remarks import stated_in_remarks, stated_pixel_m, stated_time
from cell.study.imports.text_rows import DECIMALS, REMARKS, split_line
from cell.study.imports.units import METRES, unit_of

Lines = Sequence[tuple[int, tuple[str, ...]]]

#: Rows of a header with the type or the parent of a column, not its name.
_NO_NAMES = frozenset(("type", "id", "parent"))
_AXES = frozenset(("", "x", "y", "z"))
_RATE = re.compile(r"(?:export |data |camera |capture )?(?:frame ?rate|rate|frequency|freq|fps)\b")
_COLUMNS = re.compile(r"(?:columns?|fields?)(?: names?)?\s*:\s*(.*)", re.IGNORECASE)
_UNIT_KEY = re.compile(r"(?:length )?units?\b")
#: Maximum number of characters of an unknown unit.
_LONGEST_UNIT = 4
_ORDER_KEY = re.compile(r"(?:rotation|euler)\b.*")
_MARKER_NAMES = re.compile(r"marker_?names")


@dataclass(frozen=True)
class Header:
    """Columns of a table, and metadata that apply to all of them.

    pixel_m  length of a pixel, m; None = it is not stated
    time     of all rows, and its unit; None = it is not stated
    order    of rotations about axes, such as XYZ; empty = it is not stated
    """

    columns: tuple[CapturedColumn, ...]
    rate_hz: float | None
    unit: str
    pixel_m: float | None = None
    time: tuple[float, str] | None = None
    order: str = ""


def read_header(path: Path, lines: Lines, row: Sequence[str]) -> Header:
    """Read the lines above a table.

    lines   number and cells of each
    row     cells of the table's first row
    raises  InputError: there are no names, not as many as columns, or one is repeated
    """
    width = len(row)
    rows = [(line, _without_remark(cells)) for line, cells in lines]
    rows = [(line, cells) for line, cells in rows if any(c.strip() for c in cells)]
    times = {line: time for line, cells in rows if (time := stated_time(cells)) is not None}
    rows = [(line, cells) for line, cells in rows if line not in times]
    rate_hz, unit = _stated_rate_and_unit(rows)
    units = [""] * width
    naming = list(rows)
    for at in reversed(range(len(naming))):
        if (row_units := _units_row(naming[at][1], width)) is not None:
            below = naming[at + 1 :]  # names of sensors, unless they are axes
            axes = [row for row in below if _AXES.issuperset(c.strip().lower() for c in row[1])]
            units, naming = row_units, naming[:at] + axes if naming[:at] else below
            break
    names, line = _names(path, naming, row)
    names = _with_name_of_index(naming, names)
    twice = next((n for n in names if names.count(n) > 1 and not is_time(n)), None)
    if twice is not None:
        raise repeated(path, twice, names, line)
    return Header(
        tuple(CapturedColumn(n, u) for n, u in zip(names, units, strict=True)),
        rate_hz,
        unit,
        stated_pixel_m(path, rows),
        next(reversed(times.values()), None),
        _stated_order(rows),
    )


def is_time(name: str) -> bool:
    """Whether a column may be repeated: times, which some programs write beside each point."""
    return meaning(CapturedColumn(name)).kind is ColumnKind.TIME


def repeated(path: Path, name: str, names: Sequence[str], line: int) -> InputError:
    """An error about columns with the same name."""
    both = [str(i + 1) for i, n in enumerate(names) if n == name]
    message = f"{name!r} names columns {' and '.join(both)}; give each marker and each column a "
    return InputError.at(path, f"{message}name of its own", line=line)


def _without_remark(cells: tuple[str, ...]) -> tuple[str, ...]:
    for mark in REMARKS:
        if cells and cells[0].lstrip().startswith(mark):
            first = cells[0].lstrip()[len(mark) :].strip()
            return _listed((first, *cells[1:]) if first or len(cells) < 2 else cells[1:])
    return cells


def _listed(cells: tuple[str, ...]) -> tuple[str, ...]:
    """Names behind `columns:`, up to a semicolon; other cells unchanged."""
    first, *others = cells
    if (listed := _COLUMNS.fullmatch(first)) is None:
        return cells
    names = (*filter(None, listed.groups()), *others)
    end = next((i for i, name in enumerate(names) if name.endswith(";")), len(names))
    return tuple(name.rstrip(";") for name in names[: end + 1])


def _units_row(cells: Sequence[str], width: int) -> list[str] | None:
    """Units of the columns, if a row holds only units; else None."""
    padded = _padded(cells, width)
    if padded is None:
        return None
    filled = [c.strip() for c in padded if c.strip() and c.strip() != "-"]
    units = [unit_of(c) for c in padded]
    unknown = [c for c in filled if not unit_of(c)]  # of channels that no study has, as °C
    are_units = len(filled) > 2 * len(unknown) and all(len(c) <= _LONGEST_UNIT for c in unknown)
    return units if are_units else None


def _names(path: Path, rows: Lines, row: Sequence[str]) -> tuple[list[str], int]:
    """Names of columns, joined from as few of the lowest lines as make them unique."""
    width = len(row)
    last = rows[-1][0] if rows else 1
    parts: list[list[str]] = []
    kinds: list[list[str]] = []
    unique = False
    for _, cells in reversed(rows[-8:]):
        filled = [c.strip() for c in cells if c.strip()]
        is_value = len(filled) == 2 and any(is_number(filled[1], mark) for mark in DECIMALS)
        if width > 2 and (is_value or (not parts and len(filled) == 1)):
            continue  # a word alone above the table, or with its value, is no line of names
        padded = _padded(cells, width)
        if padded is None or (not parts and len(cells) < width):
            break
        words = [c.strip() for c in padded]
        distinct = not parts and len(set(words)) == width  # by a name such as `id` among others
        if any(w.lower() in _NO_NAMES for w in words[:2]) and not distinct:
            kinds.append(words)
            continue
        if unique and words[0]:  # no line of groups, which is empty over the frames' numbers
            break
        if parts:
            words = _forward_fill(["" if w.lower() == "name" else w for w in words[:2]] + words[2:])
        parts.insert(0, words)
        names = _join(parts)
        if unique:
            break
        named = (any(column) for column in zip(*parts, strict=True))
        unique = all(n or not c.strip() for n, c in zip(named, row, strict=True))
        others = [n for n in names if not is_time(n)]
        unique = unique and len(set(others)) == len(others)
    if len(parts) == 1:
        parts = [_with_bodies(parts[0])]
    if parts:
        return _unique_names(parts, kinds), last
    for line, cells in rows:
        if _MARKER_NAMES.match(cells[0].strip().lower().replace(" ", "_")):
            return _names_of_markers(path, line, cells, width), line
    if rows and len(rows[-1][1]) > 1:
        message = f"names {len(rows[-1][1])} columns, the rows below have {width} cells; give one "
        if any("." in cell for cell in row):  # then no comma is a decimal mark
            message += "name for each, and write no names of rows (in R: row.names = FALSE)"
        else:
            message += "name for each, and quote decimal commas or separate columns by semicolons"
        raise InputError.at(path, message, line=last)
    raise InputError.at(
        path, f"has no names above its {width} columns; put a line of names there, such as "
        "time_s, tip_x_mm, tip_y_mm", line=last,
    )  # fmt: skip


def _with_name_of_index(rows: Lines, names: list[str]) -> list[str]:
    """Names with the first column's from the last of several lines, if that has no other name.

    As pandas writes an index below the levels of its columns, whose names stand above it.
    """
    if len(rows) < 2 or len(rows[-1][1]) != len(names):
        return names
    first, *others = (cell.strip() for cell in rows[-1][1])
    above = any(len(cells) == len(names) and cells[0].strip() for _, cells in rows[:-1])
    return [first, *names[1:]] if first and above and not any(others) else names


def _names_of_markers(path: Path, line: int, cells: Sequence[str], width: int) -> list[str]:
    """Columns of a table that only names its markers, three coordinates each."""
    markers = [c.strip() for c in cells[1:] if c.strip()]
    before = {0: [], 1: ["Time"], 2: ["Frame", "Time"]}.get(width - 3 * len(markers))
    if before is None:
        message = f"names {len(markers)} markers, the rows below have {width} cells, not 3 for each"
        raise InputError.at(path, f"{message}; name those that are there", line=line)
    return [*before, *(f"{m} {axis}" for m in markers for axis in "XYZ")]


def _padded(cells: Sequence[str], width: int) -> list[str] | None:
    """Cells of a line, padded to the number of columns; None if it has more or far fewer."""
    filled = list(cells)
    while filled and not filled[-1].strip() and len(filled) > width:
        filled.pop()
    # A line of groups may leave out what would be empty at its end: two columns of its last marker.
    missing = width - len(filled)
    return filled + [""] * missing if missing == 0 or (0 < missing <= 2 < len(filled)) else None


def _forward_fill(words: Sequence[str]) -> list[str]:
    """Words with a group's name, which is over its first column only, copied to the others."""
    filled, last = [], ""
    for word in words:
        last = word or last
        filled.append(last)
    return filled


#: Columns of a Qualisys body after its x, which alone has the body's name.
_OF_BODY = re.compile(r"[yz]|roll|pitch|yaw|residual|rot\[\d]", re.IGNORECASE)


def _with_bodies(names: Sequence[str]) -> list[str]:
    """Names with that of their body, where `Gripper X` is followed by `Y`, `Z`, `Roll`, …"""
    full_names, body = [], ""
    for i, name in enumerate(names):
        begins = re.fullmatch(r"(.+)[ _]x", name, re.IGNORECASE)
        if begins and [n.lower() for n in names[i + 1 : i + 3]] == ["y", "z"]:
            body = begins[1]
            full_names.append(name)
            continue
        body = body if _OF_BODY.fullmatch(name) else ""
        full_names.append(f"{body} {name}".strip())
    return full_names


def _unique_names(parts: Sequence[Sequence[str]], kinds: Sequence[Sequence[str]]) -> list[str]:
    """Names of columns; repeated ones are completed by the words of the lines of kinds.

    A body's marker and the same one by itself have one name in some programs.
    """
    names = _join(parts)
    for words in reversed(kinds):
        names = [
            f"{name} {word}" if names.count(name) > 1 and word else name
            for name, word in zip(names, _forward_fill(words), strict=True)
        ]
    return names


def _join(parts: Sequence[Sequence[str]]) -> list[str]:
    names = [" ".join(dict.fromkeys(w for w in words if w)) for words in zip(*parts, strict=True)]
    return [name or f"column {i}" for i, name in enumerate(names, 1)]


def _keys_and_values(rows: Lines) -> Iterator[tuple[str, str]]:
    """Each two neighbouring words of remarks, the first in small letters."""
    for _, cells in rows:
        words = [w.strip() for cell in cells for w in re.split(r"[:=]", cell) if w.strip()]
        yield from ((key.lower(), value) for key, value in pairwise(words))


def _stated_rate_and_unit(rows: Lines) -> tuple[float | None, str]:
    rate_hz, unit = None, ""
    for key, value in _keys_and_values(rows):
        stated = number(value.split()[0], ".") or 0.0
        preferred = rate_hz is None or key.startswith("export")  # others are of the cameras
        if preferred and _RATE.match(key) and stated > 0.0:
            rate_hz = stated
        if not unit and _UNIT_KEY.match(key) and unit_of(value) in METRES:
            unit = unit_of(value)
    in_remarks, its_unit = stated_in_remarks(rows)
    return rate_hz or in_remarks or _rate_below_title(rows), unit or its_unit


def _stated_order(rows: Lines) -> str:
    """Order of rotations that a remark states, such as Motive's `Rotation Type,XYZ`."""
    orders = (value.upper() for key, value in _keys_and_values(rows) if _ORDER_KEY.fullmatch(key))
    return next((order for order in orders if sorted(order) == ["X", "Y", "Z"]), "")


def _rate_below_title(rows: Lines) -> float | None:
    """Rate of a section of Vicon's: a number alone in its line, below a title alone in its own."""
    alone = [[c for c in cells if c.strip()] for _, cells in rows[:2]]
    if [len(cells) for cells in alone] != [1, 1] or number(alone[0][0], ".") is not None:
        return None
    rate_hz = number(alone[1][0], ".") or 0.0
    return rate_hz if rate_hz > 0.0 else None


#: Ends a header of LabVIEW's; the first is of the file, the second of a table.
_END_OF_HEADER = "***End_of_Header***"
_UNITS, _STEP = "Y_Unit_Label", "Delta_X"


def without_properties(lines: Sequence[str], separator: str) -> list[str]:
    """Lines of LabVIEW's text without the rows of properties above its table's names.

    The number of lines is kept, so that line numbers stay right; units are below the names.
    """
    result = list(lines)
    ends = [i for i, line in enumerate(result) if line.startswith(_END_OF_HEADER)]
    if len(ends) != 2 or ends[1] + 1 >= len(result):  # several tables keep their headers
        return result
    end, names = ends[1], result[ends[1] + 1]
    below = result[end + 2].count(separator) if end + 2 < len(result) else 0
    if below < names.count(separator):  # rows without a comment have no cell for one
        names = names.removesuffix(f"{separator}Comment")
    units = next((line for line in result[:end] if line.startswith(_UNITS)), _UNITS)
    step = next((line for line in result[:end] if line.startswith(_STEP)), "").split(separator)[1:2]
    result[:end] = [""] * end
    if step and (step_s := number(step[0], "," if "," in step[0] else ".")):
        result[0] = f"rate{separator}{1.0 / step_s:.12g}"
    result[end], result[end + 1] = names, units.removeprefix(_UNITS)
    if not result[end + 1].strip(f"{separator} \t"):
        result[end], result[end + 1] = "", names
    return result


#: `A. Time (sec)`, `ch1: tip x [mm]`.
_ENTRY = re.compile(r"[\s#%]*([A-Za-z]{0,3}\d*)\s*[.:=)]\s+(\S.*?)[\s,;]*")
#: Lines that are searched for the list and the names, and fewest columns.
_MAX_LINES, _MIN_WIDTH = 300, 3
_UNIT = re.compile(r"\s*[\[(][^\[\]()]*[\])]\s*$")


def with_legend(lines: Sequence[str], separator: str) -> list[str]:
    """The lines, with the letters of a line of names replaced by the names of a list."""
    legend: dict[str, str] = {}
    for i, line in enumerate(lines[:_MAX_LINES]):
        cells = [cell.strip() for cell in split_line(line, separator)]
        while cells and not cells[-1]:
            cells.pop()
        if len(cells) >= _MIN_WIDTH and len(set(cells)) == len(cells) and set(cells) <= set(legend):
            names = _without_common([legend[cell] for cell in cells])
            joint = "\t" if separator == " " else separator
            quoted = [f'"{n}"' if separator in n and separator != " " else n for n in names]
            return [*lines[:i], joint.join(quoted), *lines[i + 1 :]]
        if (entry := _ENTRY.fullmatch(line)) and entry[1]:
            legend[entry[1]] = entry[2]
    return list(lines)


def _without_common(names: Sequence[str]) -> list[str]:
    """Names without the first and the last part that all dotted names have in common."""
    dotted = [_UNIT.sub("", n).strip(".").split(".") for n in names if "." in _UNIT.sub("", n)]
    if len(dotted) < _MIN_WIDTH:
        return list(names)
    before = min(len(d) for d in dotted) > 1 and len({d[0] for d in dotted}) == 1
    behind = min(len(d) for d in dotted) > 1 + before and len({d[-1] for d in dotted}) == 1
    result = []
    for name in names:
        bare = _UNIT.sub("", name)
        if "." not in bare:
            result.append(name)
            continue
        parts = bare.strip(".").split(".")
        parts = parts[1 if before else 0 : -1 if behind else None]
        result.append(".".join(parts) + name[len(bare) :])
    return result
