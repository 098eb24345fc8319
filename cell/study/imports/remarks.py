"""Reads rate, units and pixel size from remarks above a table, and units from its cells."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cell.files.input_error import InputError
from cell.study.imports.capture import NOT_SEEN, CapturedColumn, Decimal
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.text_rows import WITH_UNIT, Row, unit_behind
from cell.study.imports.units import METRES, RADIANS, SECONDS, unit_of

_Lines = Sequence[tuple[int, tuple[str, ...]]]

_VALUE = r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)"
_RATES = (
    re.compile(rf"\b(?:fps|frame[ _]?rate|sampl(?:e|ing)[ _]?rate)\s*[:=]\s*{_VALUE}", re.I),
    re.compile(rf"{_VALUE}\s*(?:fps|frames?/s|frames? per second)\b", re.I),
)
_UNITS = re.compile(r"\b(?:length )?units?\s*[:=]\s*([^\W\d]+)", re.I)
_LONG = r"(mm|cm|µm|um|m)"
_PIXELS = (
    re.compile(rf"\b{_LONG}[ _]?(?:per|/)[ _]?(?:px|pixels?)\s*[:=]\s*{_VALUE}", re.I),
    re.compile(rf"{_VALUE}\s*{_LONG}\s*(?:per|/)\s*(?:px|pixel)\b", re.I),
    re.compile(rf"\b1\s*(?:px|pixel)\s*=\s*{_VALUE}\s*{_LONG}\b", re.I),
    re.compile(rf"\b(?:px|pixels?)[ _]?(?:per|/)[ _]?{_LONG}\s*[:=]\s*{_VALUE}", re.I),
)


_TIME = re.compile(r"([^\W\d][^:=]*?)\s*[:=]\s*([-+]?\d+(?:[.,]\d+)?(?:e[-+]?\d+)?)\s*(\w*)", re.I)


def stated_time(cells: Sequence[str]) -> tuple[float, str] | None:
    """Time that a remark states for all rows below it, and its unit; None = it states none."""
    match = _TIME.fullmatch(" ".join(" ".join(cells).lstrip("#%/ ").split()))
    by_name = meaning(CapturedColumn(match[1])) if match else None
    if match is None or by_name is None or by_name.kind is not ColumnKind.TIME:
        return None
    unit = unit_of(match[3]) or by_name.unit
    known = unit in SECONDS or not match[3]
    return (float(match[2].replace(",", ".")), unit) if known else None


def _texts(rows: _Lines) -> list[tuple[int, str]]:
    """Line numbers, and texts of their filled cells."""
    return [(line, ", ".join(c for c in cells if c.strip())) for line, cells in rows]


def stated_in_remarks(rows: _Lines) -> tuple[float | None, str]:
    """Rate and unit of length in the text of remarks; each only if it is unambiguous."""
    texts = [text for _, text in _texts(rows)]
    rates = {float(match[1]) for text in texts for form in _RATES for match in form.finditer(text)}
    rates.discard(0.0)
    units = {unit_of(match[1]) for text in texts for match in _UNITS.finditer(text)} & set(METRES)
    return (rates.pop() if len(rates) == 1 else None), (units.pop() if len(units) == 1 else "")


def stated_pixel_m(path: Path, rows: _Lines) -> float | None:
    """Length of a pixel, m, that remarks state.  Raises InputError: they state two."""
    sizes: dict[float, int] = {}
    for line, text in _texts(rows):
        for form in _PIXELS:
            for match in form.finditer(text):
                part_1, part_2 = match[1], match[2]
                value, unit = (part_2, part_1) if unit_of(part_1) else (part_1, part_2)
                if (size := float(value)) > 0.0:
                    size = 1.0 / size if form is _PIXELS[-1] else size
                    sizes.setdefault(size * METRES[unit_of(unit)], line)
    if len(sizes) > 1:
        first, second = list(sizes)[:2]
        message = f"a pixel is {first * 1e3:g} mm long here and {second * 1e3:g} mm in line "
        message += f"{sizes[second]}; leave the right one"
        raise InputError.at(path, message, line=sizes[first])
    return next(iter(sizes), None)


def without_units(
    path: Path, table: Sequence[Row], stated: Sequence[CapturedColumn], decimal: Decimal
) -> tuple[list[Row], tuple[CapturedColumn, ...]]:
    """Move units from cells, such as `0.004 sec`, to the columns.

    raises  InputError: a cell has another unit than its column
    """
    columns, rows = list(stated), list(table)
    for index, column in enumerate(columns):
        all_cells = (row.cells[index] for row in rows)
        filled = next((c for c in all_cells if c.strip().lower() not in NOT_SEEN), "")
        first = _unit_behind(filled, decimal)
        if not first:
            continue
        row_of_unit = {unit: row for row in rows[::-1]
                       if (unit := _unit_behind(row.cells[index], decimal))}  # fmt: skip
        column_unit = column.unit or first
        other = next((unit for unit in row_of_unit if unit != column_unit), None)
        if other is not None:
            message = f"is in {other}, the column in {column_unit}; give one unit"
            raise InputError.at(path, message, line=row_of_unit[other].line, key=column.name)
        columns[index] = replace(column, unit=column_unit)
        for i, row in enumerate(rows):
            if match := WITH_UNIT.fullmatch(row.cells[index].strip()):
                cells = (*row.cells[:index], match[1], *row.cells[index + 1 :])
                rows[i] = Row(row.line, cells)
    return rows, tuple(columns)


def _unit_behind(cell: str, decimal: Decimal) -> str:
    """The unit of time, length or angle after a number; empty = there is none."""
    unit = unit_behind(cell, decimal)
    return unit if unit in (*METRES, *SECONDS, *RADIANS) else ""
