"""Times of day: with the date of a column beside them, and over midnight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import CapturedColumn, is_clock, is_day_time, is_number
from cell.study.imports.text_rows import Row

_DAY_S = 86_400.0


def with_dates(
    table: Sequence[Row], columns: Sequence[CapturedColumn]
) -> tuple[Sequence[Row], Sequence[CapturedColumn]]:
    """The table with the dates of a column before the times of day of the column behind it."""
    for k in range(len(columns) - 1):
        if not _moment(*table[0].cells[k : k + 2]):
            continue
        moments = [_moment(*row.cells[k : k + 2]) for row in table]
        if all(moments):
            rows = [replace(row, cells=(*row.cells[:k], moment, *row.cells[k + 2 :]))
                    for row, moment in zip(table, moments, strict=True)]  # fmt: skip
            return rows, [*columns[:k], *columns[k + 1 :]]
    return table, columns


def _moment(date: str, time: str) -> str:
    """A date and a time of day in one cell; empty = they are none."""
    if not is_day_time(time) or not date.strip()[:1].isdigit() or is_day_time(date):
        return ""
    day = date.strip().removesuffix(" 00:00:00")  # as a workbook has it
    text = f"{day} {time.strip()}"
    return text if is_clock(text) and is_number(text, ".") else ""


def over_midnight(t_s: FloatArray) -> FloatArray:
    """(rows,) times of day, where a step back by more than half a day is to the next day."""
    steps = np.diff(t_s, prepend=t_s[:1])
    days = np.cumsum(np.where(np.abs(steps) > _DAY_S / 2, -np.sign(steps), 0.0))
    return t_s + _DAY_S * np.maximum(days, 0.0)
