"""Cells that hold several numbers, such as the coordinates of a point: `1.0,2.0,3.0`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from cell.study.imports.capture import NOT_SEEN
from cell.study.imports.text_rows import split_line

_NUMBER = r"(?:[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?nan)"
_SEVERAL = re.compile(
    rf"([\[(<]?)\s*({_NUMBER}(?:\s*[,;]\s*{_NUMBER}|\s+{_NUMBER}){{1,3}})\s*[\])>]?", re.IGNORECASE
)
_SINGLE = re.compile(_NUMBER, re.IGNORECASE)
_BETWEEN = re.compile(r"\s*[,;]\s*|\s+")
_SEPARATORS = ("\t", ";", "|", ",")
#: Brackets, without which a cell between commas holds a single number.
_OPENING = "[(<"
_MIN_ROWS, _MIN_FRACTION = 3, 0.9
#: Lines in which a table may begin: motion capture writes a dozen above it, others up to 200.
_HEAD_LINES = 300
#: Names of two or three coordinates; header line of columns of quaternions.
_AXES = {2: "xy", 3: "xyz"}
_QUATERNION = re.compile(r"^\s*[#%]?\s*DataType\s*[=:]\s*Quaternion\s*$", re.IGNORECASE)


def with_single_cells(lines: Sequence[str]) -> list[str]:
    """Lines with each number in a separate cell, and an axis added to each name.

    source  OpenSim 4, storage files: Vec3 is x, y, z; Quaternion is w, x, y, z
    """
    for separator in _SEPARATORS:
        if not any(_in_line(line, separator) for line in lines[:_HEAD_LINES]):
            continue
        rows = [split_line(line, separator) for line in lines]
        data = [i for i, row in enumerate(rows) if any(_parts(c, separator) for c in row)]
        widths = Counter(len(rows[i]) for i in data).most_common(1)
        if not widths or widths[0][1] < _MIN_ROWS:
            continue
        width = widths[0][0]
        first = next(i for i in data if len(rows[i]) == width)
        below = [rows[i] for i in range(first, len(rows)) if len(rows[i]) == width]
        valid = [row for row in below if all(_is_cell(c, separator) for c in row)]
        if width < 2 or len(valid) < _MIN_FRACTION * len(below) or first == 0:
            continue
        counts = [_usual(column, separator) for column in zip(*valid, strict=True)]
        quaternion = any(_QUATERNION.match(line) for line in lines[:first])
        above = max((i for i in range(first) if len(rows[i]) == width), default=None)
        return [
            separator.join(_spread(row, counts, separator)) if i >= first and len(row) == width
            else separator.join(_named(row, counts, quaternion)) if i == above
            else lines[i]
            for i, row in enumerate(rows)
        ]  # fmt: skip
    return list(lines)


def _in_line(line: str, separator: str) -> bool:
    if separator not in line or (separator == "," and not any(b in line for b in _OPENING)):
        return False
    return any(_parts(c, separator) for c in split_line(line, separator))


def _parts(cell: str, separator: str) -> list[str]:
    """The numbers of a cell with several; empty = it has one or none.

    Two numbers around a comma that have no brackets and no points may be one with a decimal comma.
    """
    match = _SEVERAL.fullmatch(cell.strip())
    if match is None or (separator == "," and not match[1]):
        return []
    if not match[1] and "." not in cell and "nan" not in cell.lower():
        return []
    return _BETWEEN.split(match[2].strip())


def _is_cell(cell: str, separator: str) -> bool:
    bare = cell.strip()
    single = bare.lower() in NOT_SEEN or _SINGLE.fullmatch(bare) is not None
    return single or bool(_parts(cell, separator))


def _usual(column: Sequence[str], separator: str) -> int:
    """How many numbers the cells of a column have."""
    counts = Counter(len(parts) for c in column if (parts := _parts(c, separator)))
    return counts.most_common(1)[0][0] if counts else 1


def _spread(row: Sequence[str], counts: Sequence[int], separator: str) -> list[str]:
    split: list[str] = []
    for cell, count in zip(row, counts, strict=True):
        parts = _parts(cell, separator)
        split += (parts if len(parts) == count else [""] * count) if count > 1 else [cell]
    return split


def _named(row: Sequence[str], counts: Sequence[int], quaternion: bool) -> list[str]:
    names: list[str] = []
    for cell, count in zip(row, counts, strict=True):
        name = cell.strip()
        axes = _AXES.get(count, "0123"[:count])
        if count == 4 and quaternion:
            axes, name = "wxyz", f"{name} quaternion"
        names += [f"{name} {axis}" for axis in axes] if count > 1 else [name]
    return names
