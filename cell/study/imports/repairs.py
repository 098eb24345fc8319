"""Repairs values of a file: codes for gaps, held rows, mixed units, interrupted tracks."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.words import first_of
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import Point, contents
from cell.study.imports.units import METRES

#: Smallest code that programs write for missing values; no measurement is so large.
_MIN_CODE = 1e20


def repaired(capture: Capture) -> Capture:
    """The file after the repairs of units and tracks, each of which adds a note."""
    return with_whole_tracks(with_one_unit(in_millimetres(capture)))


def without_codes(capture: Capture) -> Capture:
    """Replace codes for missing values by nan."""
    codes = np.abs(capture.values) >= _MIN_CODE
    count = int(np.count_nonzero(codes))
    if not count:
        return capture
    value = float(capture.values[codes][0])
    note = f"{capture.path}: {value:g} stands in {count} cells: nothing was seen there"
    values = np.where(codes, np.nan, capture.values)
    return replace(capture, values=values, notes=(*capture.notes, note))


def in_millimetres(capture: Capture) -> Capture:
    """Convert positions in pixels to mm, if the file states the length of a pixel."""
    size_m = capture.pixel_m
    points = [p for p in contents(capture).points if p.unit == "px"]
    if size_m is None or not points:
        return capture
    note = f"{capture.path}: places in pixels are read as mm, for it states {size_m * 1e3:g} mm "
    scaled = _scaled(capture, {c: (size_m * 1e3, "mm") for p in points for c in p.columns})
    return replace(scaled, notes=(*capture.notes, f"{note}a pixel"))


def with_one_unit(capture: Capture) -> Capture:
    """Convert all positions to metres, if the file states different units for them."""
    points = contents(capture).points
    units = sorted({p.unit for p in points})
    if len(units) < 2 or not set(units) <= set(METRES):
        return capture
    factors = {c: (METRES[p.unit], "m") for p in points for c in p.columns}
    note = f"{capture.path}: some places are in {' and others in '.join(units)}; all are read as m"
    return replace(_scaled(capture, factors), notes=(*capture.notes, note))


def _scaled(capture: Capture, factors: dict[str, tuple[float, str]]) -> Capture:
    """Multiply columns by factors, and set their new units."""
    each = [factors.get(c.name, (1.0, c.unit)) for c in capture.columns]
    columns = tuple(
        CapturedColumn(c.name, unit) for c, (_, unit) in zip(capture.columns, each, strict=True)
    )
    return replace(
        capture, columns=columns, values=capture.values * np.array([factor for factor, _ in each])
    )


#: Maximum rows between the end of a track and the start of its continuation …
_GAP_ROWS = 100
#: … and maximum distance between both, as a fraction of the distance to other points.
_MAX_DISTANCE = 0.5
#: Number of nearest points, whose mean motion is assumed for the track while it is lost.
_NEIGHBOURS = 2


def with_whole_tracks(capture: Capture) -> Capture:
    """Join tracks of one marker that was lost and detected again under a new name.

    Tracks are joined if their names differ in numbers only, one ends before the other begins, and
    no third point is near.  The first one's columns then hold both.
    """
    points = [p for p in contents(capture).points if not p.on_gripper]
    while (pair := _continued(capture, points)) is not None:
        first, second = pair
        values = capture.values.copy()
        places = np.array([capture.names.index(c) for c in first.columns])
        continuation = capture.at(second.columns)
        visible = np.isfinite(continuation).all(axis=1)
        values[np.ix_(np.flatnonzero(visible), places)] = continuation[visible]
        removed = set(second.columns)
        remaining = [i for i, name in enumerate(capture.names) if name not in removed]
        note = f"{capture.path}: {second.name!r} begins where {first.name!r} ends: it is one marker"
        capture = replace(
            capture,
            columns=tuple(capture.columns[i] for i in remaining),
            values=values[:, remaining],
            notes=(*capture.notes, note),
        )
        points.remove(second)
    return capture


def _continued(capture: Capture, points: Sequence[Point]) -> tuple[Point, Point] | None:
    """A track and its continuation; None = there is none."""
    raw = {p.name: capture.at(p.columns) for p in points}
    rows = {n: np.flatnonzero(np.isfinite(r).all(axis=1)) for n, r in raw.items()}
    for first, second in permutations(points, 2):
        before, after = rows[first.name], rows[second.name]
        same_name = re.sub(r"\d+", "", first.name) == re.sub(r"\d+", "", second.name)
        if not same_name or len(first.columns) != len(second.columns) or not len(before):
            continue
        if not len(after) or not 0 < after[0] - before[-1] <= _GAP_ROWS:
            continue
        others = [raw[p.name] for p in points if p not in (first, second)]
        if _continues(raw[first.name], raw[second.name], others, (int(before[-1]), int(after[0]))):
            return first, second
    return None


def _continues(
    first: FloatArray, second: FloatArray, others: Sequence[FloatArray], rows: tuple[int, int]
) -> bool:
    """Whether the second track continues the first, if it moved as its nearest points.

    rows  last row of the first track, and first row of the second
    """
    end, begin = rows
    comparable = [o for o in others if o.shape[1] == first.shape[1] == second.shape[1]]
    visible = [o for o in comparable if np.isfinite(o[end] + o[begin]).all()]
    if not visible:
        return False
    from_end = np.array([np.linalg.norm(o[end] - first[end]) for o in visible])
    from_begin = np.array([np.linalg.norm(o[begin] - second[begin]) for o in visible])
    moved = np.array([o[begin] - o[end] for o in visible])
    expected = moved[np.argsort(from_end)[:_NEIGHBOURS]].mean(axis=0)
    distance = float(np.linalg.norm(second[begin] - first[end] - expected))
    return distance < _MAX_DISTANCE * float(min(from_end.min(), from_begin.min()))


_COORDINATES = (ColumnKind.COORDINATE,)
_VISIBLE = frozenset(("v", "vis", "visibility"))


def without_hidden(capture: Capture) -> Capture:
    """Replace positions by nan where a visibility column (1 or 0) is 0.

    It belongs to the point of its name, else to the point in the columns before it.
    """
    kinds = [meaning(c) for c in capture.columns]
    values, notes = capture.values.copy(), list(capture.notes)
    for index, column in enumerate(capture.columns):
        words = re.split(r"[^a-z0-9]+|_", column.name.lower())
        visible = capture.values[:, index]
        if words[-1] not in _VISIBLE or set(np.unique(visible)) != {0.0, 1.0}:
            continue
        indices, group = [], None
        for before in range(index - 1, -1, -1):
            if kinds[before].kind not in _COORDINATES or group not in (None, kinds[before].group):
                break
            group = kinds[before].group
            indices.append(before)
        name = " ".join(words[:-1])
        by_name = [i for i, m in enumerate(kinds) if m.kind in _COORDINATES and m.group == name]
        indices = by_name or indices
        hidden = visible == 0.0
        if len(indices) < 2:
            continue
        values[np.ix_(np.flatnonzero(hidden), np.array(indices))] = np.nan
        point = kinds[indices[0]].group
        count = int(np.count_nonzero(hidden))
        notes.append(
            f"{capture.path}: {column.name!r} is 0 in {count} rows: {point!r} was not seen there"
        )
    return replace(capture, values=values, notes=tuple(notes))


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
    return replace(capture, values=values, notes=(*capture.notes, *held_notes))
