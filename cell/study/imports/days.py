"""Times of day: with the date of a column beside them, and over midnight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, CapturedColumn, is_clock, is_day_time, is_number
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.text_rows import Row

_DAY_S = 86_400.0
#: Days from 1899-12-30, from which spreadsheets count, to 1970; resolution of a coarse clock.
_DAYS_TO_1970, _COARSE_S = 25_569, 1.0


def with_dates(
    table: Sequence[Row], columns: tuple[CapturedColumn, ...]
) -> tuple[Sequence[Row], tuple[CapturedColumn, ...]]:
    """The table with the dates of a column before the times of day of the column behind it."""
    for k in range(len(columns) - 1):
        if not _moment(*table[0].cells[k : k + 2]):
            continue
        moments = [_moment(*row.cells[k : k + 2]) for row in table]
        if all(moments):
            rows = [replace(row, cells=(*row.cells[:k], moment, *row.cells[k + 2 :]))
                    for row, moment in zip(table, moments, strict=True)]  # fmt: skip
            return rows, (*columns[:k], *columns[k + 1 :])
    return table, columns


def _moment(date: str, time: str) -> str:
    """A date and a time of day in one cell; empty = they are none."""
    if not is_day_time(time) or not date.strip()[:1].isdigit() or is_day_time(date):
        return ""
    day = date.strip().removesuffix(" 00:00:00")  # as a workbook has it
    text = f"{day} {time.strip()}"
    return text if is_clock(text) and is_number(text, ".") else ""


def with_fine_times(capture: Capture, clocks: Sequence[str]) -> Capture:
    """The table with a column that counts days, instead of a coarser clock of dates that it tells.

    clocks  columns of dates with times of day
    source  Siemens WinCC, data log: `Time_ms` is a million times the days since 1899-12-30
    """
    for clock, fine in permutations(capture.names, 2):
        if clock not in clocks or fine in clocks:
            continue
        if meaning(CapturedColumn(fine)).kind is not ColumnKind.TIME:
            continue
        of_clock, days = capture.column(clock), capture.column(fine)
        if len(np.unique(days)) <= len(np.unique(of_clock)):  # it is no finer
            continue
        for unit_s in (_DAY_S, _DAY_S / 1e6):
            t_s = days * unit_s - _DAYS_TO_1970 * _DAY_S
            if np.all(np.abs(t_s - of_clock) <= _COARSE_S):
                names = capture.names
                columns = [replace(c, unit="s") if c.name == fine else c for c in capture.columns]
                values = capture.values.copy()
                values[:, names.index(fine)] = t_s
                note = (
                    f"{capture.path}: {fine!r} counts {unit_s:g} s since 1899-12-30, as {clock!r} "
                )
                kept = [i for i, name in enumerate(names) if name != clock]
                told = replace(capture, columns=tuple(columns), values=values).of_columns(kept)
                return told.noted(f"{note}shows, which is coarser and is not read")
    return capture


def over_midnight(t_s: FloatArray) -> FloatArray:
    """(rows,) times of day, where a step back by more than half a day is to the next day."""
    steps = np.diff(t_s, prepend=t_s[:1])
    days = np.cumsum(np.where(np.abs(steps) > _DAY_S / 2, -np.sign(steps), 0.0))
    return np.asarray(t_s + _DAY_S * np.maximum(days, 0.0))
