"""Repairs values of a file: codes for gaps, held rows, mixed units, interrupted tracks, dates."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.words import first_of
from cell.study.imports.capture import Capture, CapturedColumn, is_clock, is_day_time, is_number
from cell.study.imports.column_names import ColumnKind, displacement, meaning, visibility
from cell.study.imports.contents import contents
from cell.study.imports.text_rows import Row
from cell.study.imports.tracks import joined_tracks
from cell.study.imports.units import METRES

#: Smallest code that programs write for missing values; no measurement is so large.
_MIN_CODE = 1e20


def without_codes(capture: Capture) -> Capture:
    """Replace codes for missing values by nan."""
    codes = np.abs(capture.values) >= _MIN_CODE
    count = int(np.count_nonzero(codes))
    if not count:
        return capture
    value = float(capture.values[codes][0])
    note = f"{capture.path}: {value:g} stands in {count} cells: nothing was seen there"
    values = np.where(codes, np.nan, capture.values)
    return replace(capture, values=values).noted(note)


def with_displacements(capture: Capture) -> Capture:
    """Add displacements of points, such as `P1 U` and `P1 V`, to places that are constant.

    Those are the initial places; a place that varies contains its displacement.
    """
    meanings = [(c, meaning(c)) for c in capture.columns]
    place_of = {(m.group, m.axis): c.name for c, m in meanings if m.kind is ColumnKind.COORDINATE}
    of_place = {c.name: place_of.get(displacement(c) or ("", "")) for c in capture.columns}
    pairs = [(place, name) for name, place in of_place.items() if place is not None]
    known = [column[np.isfinite(column)] for column in (capture.column(p) for p, _ in pairs)]
    if not pairs or any(len(column) == 0 or np.ptp(column) > 0.0 for column in known):
        return capture
    values, names = capture.values.copy(), capture.names
    for place, name in pairs:
        values[:, names.index(place)] += capture.column(name)
    remaining = [i for i, name in enumerate(names) if of_place[name] is None]
    place, name = pairs[0]
    note = f"{capture.path}: {place!r} is constant: the displacement {name!r} is added to it"
    return replace(capture, values=values).of_columns(remaining).noted(note)


def in_millimetres(capture: Capture) -> Capture:
    """Convert positions in pixels to mm, if the file states the length of a pixel."""
    size_m = capture.pixel_m
    points = [p for p in contents(capture).points if p.unit == "px"]
    if size_m is None or not points:
        return capture
    note = f"{capture.path}: places in pixels are read as mm, for it states {size_m * 1e3:g} mm "
    scaled = _scaled(capture, {c: (size_m * 1e3, "mm") for p in points for c in p.columns})
    return scaled.noted(f"{note}a pixel")


def with_one_unit(capture: Capture) -> Capture:
    """Convert all positions to metres, if the file states different units for them."""
    points = contents(capture).points
    units = sorted({p.unit for p in points})
    if len(units) < 2 or not set(units) <= set(METRES):
        return capture
    factors = {c: (METRES[p.unit], "m") for p in points for c in p.columns}
    note = f"{capture.path}: some places are in {' and others in '.join(units)}; all are read as m"
    return _scaled(capture, factors).noted(note)


def _scaled(capture: Capture, factors: dict[str, tuple[float, str]]) -> Capture:
    each = [factors.get(c.name, (1.0, c.unit)) for c in capture.columns]
    factor_of, units = zip(*each, strict=True)
    columns = tuple(replace(c, unit=u) for c, u in zip(capture.columns, units, strict=True))
    return replace(capture, columns=columns, values=capture.values * np.array(factor_of))


#: Maximum rows between the end of a track and the start of its continuation.
_GAP_ROWS = 100


def with_whole_tracks(capture: Capture) -> Capture:
    """Join tracks of one marker that was lost and detected again under a new name.

    Tracks are joined as those of a tracking program, if their names differ in numbers only.  The
    first one's columns then hold both.
    """
    points = [p for p in contents(capture).points if not p.on_gripper]
    points = [p for p in points if len(p.columns) == len(points[0].columns)]
    if len(points) < 3:
        return capture
    families = [re.sub(r"\d+", "", p.name) for p in points]
    heads = joined_tracks(np.stack([capture.at(p.columns) for p in points]), _GAP_ROWS, families)
    values, notes, removed = capture.values.copy(), list[str](), set[str]()
    for second, first in zip(points, (points[head] for head in heads), strict=True):
        if second is not first:
            continuation = capture.at(second.columns)
            rows = np.flatnonzero(np.isfinite(continuation).all(axis=1))
            places = [capture.names.index(c) for c in first.columns]
            values[np.ix_(rows, np.array(places))] = continuation[rows]
            removed |= set(second.columns)
            sentence = f"{second.name!r} begins where {first.name!r} ends: it is one marker"
            notes.append(f"{capture.path}: {sentence}")
    remaining = [i for i, name in enumerate(capture.names) if name not in removed]
    return replace(capture, values=values).of_columns(remaining).noted(*notes)


def without_unseen(capture: Capture) -> Capture:
    """Replace positions by nan where a column of confidence or visibility is below its threshold.

    It belongs to the point of its name; a flag, which is 1 or 0, else to the point in the columns
    before it.  A confidence that is low in more than half of the rows is ignored.
    """
    kinds = [meaning(c) for c in capture.columns]
    groups = [m.group if m.kind is ColumnKind.COORDINATE else None for m in kinds]
    values, notes = capture.values.copy(), list[str]()
    for index, (column, shown) in enumerate(zip(capture.columns, capture.values.T, strict=True)):
        if (of := visibility(column)) is None:
            continue
        group, threshold, is_flag = of
        unseen, places = shown < threshold, [i for i, g in enumerate(groups) if g == group]
        if is_flag and not places:
            first, before = index, groups[index - 1]
            while first and before is not None and groups[first - 1] == before:
                first -= 1
            places = list(range(first, index))
        count = int(np.count_nonzero(unseen))
        plausible = set(np.unique(shown)) == {0.0, 1.0} if is_flag else 2 * count <= len(shown)
        if not count or not places or not plausible:
            continue
        values[np.ix_(unseen, np.array(places))] = np.nan
        notes.append(
            f"{capture.path}: {column.name!r} is below {threshold:g} in {count} rows: "
            f"{kinds[places[0]].group!r} is taken as not seen there"
        )
    return replace(capture, values=values).noted(*notes)


#: Minimum fraction of positions that are held for the same number of rows, and minimum count.
_MIN_REGULAR = 0.8
_MIN_COUNT = 10


def without_held(capture: Capture) -> Capture:
    """Replace positions by nan that a program repeats until the next one is measured.

    Positions are held if each is repeated in the same number of rows, two at least.
    """
    values, held = capture.values, dict[int, list[str]]()
    for point in contents(capture).points:
        columns = [capture.names.index(name) for name in point.columns]
        places = capture.values[:, columns]
        is_new = np.append(True, np.any(np.diff(places, axis=0) != 0.0, axis=1))
        starts = np.flatnonzero(is_new)
        if len(starts) < _MIN_COUNT or len(starts) * 2 > len(places):
            continue
        rows, count = Counter(np.diff(starts).tolist()).most_common(1)[0]
        if rows < 2 or count < _MIN_REGULAR * (len(starts) - 1):
            continue
        values = values.copy() if values is capture.values else values
        values[np.ix_(~is_new, np.array(columns))] = np.nan
        held.setdefault(rows, []).append(point.name)
    held_notes = [
        f"{capture.path}: each place of {first_of(names, 3)} stands in {rows} rows: it is measured "
        "in the first, and only held in the others, which are not read"
        for rows, names in held.items()
    ]
    return replace(capture, values=values).noted(*held_notes)


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
