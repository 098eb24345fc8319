"""Values of a file brought to one form: no codes for gaps, no held rows, one unit, whole tracks."""

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

#: No measurement in any unit is so large; programs write such numbers where nothing was seen.
_NO_VALUE = 1e20


def repaired(capture: Capture) -> Capture:
    """The file with all of these repairs, each of which adds a note."""
    return with_whole_tracks(with_one_unit(in_millimetres(capture)))


def without_codes(capture: Capture) -> Capture:
    """Without numbers that are too large for any measurement."""
    codes = np.abs(capture.values) >= _NO_VALUE
    count = int(np.count_nonzero(codes))
    if not count:
        return capture
    value = float(capture.values[codes][0])
    note = f"{capture.path}: {value:g} stands in {count} cells: nothing was seen there"
    values = np.where(codes, np.nan, capture.values)
    return replace(capture, values=values, notes=(*capture.notes, note))


def in_millimetres(capture: Capture) -> Capture:
    """With places in pixels as places in mm, where the file states how long a pixel is."""
    size_m = capture.pixel_m
    points = [p for p in contents(capture).points if p.unit == "px"]
    if size_m is None or not points:
        return capture
    note = f"{capture.path}: places in pixels are read as mm, for it states {size_m * 1e3:g} mm "
    scaled = _scaled(capture, {c: (size_m * 1e3, "mm") for p in points for c in p.columns})
    return replace(scaled, notes=(*capture.notes, f"{note}a pixel"))


def with_one_unit(capture: Capture) -> Capture:
    """With all places in metres, where the file states one unit for some and another for others."""
    points = contents(capture).points
    units = sorted({p.unit for p in points})
    if len(units) < 2 or not set(units) <= set(METRES):
        return capture
    factors = {c: (METRES[p.unit], "m") for p in points for c in p.columns}
    note = f"{capture.path}: some places are in {' and others in '.join(units)}; all are read as m"
    return replace(_scaled(capture, factors), notes=(*capture.notes, note))


def _scaled(capture: Capture, factors: dict[str, tuple[float, str]]) -> Capture:
    """With columns multiplied, and their new unit."""
    each = [factors.get(c.name, (1.0, c.unit)) for c in capture.columns]
    columns = tuple(
        CapturedColumn(c.name, unit) for c, (_, unit) in zip(capture.columns, each, strict=True)
    )
    return replace(
        capture, columns=columns, values=capture.values * np.array([factor for factor, _ in each])
    )


#: A track goes on with another one that begins at most so many rows after its end …
_GAP_ROWS = 100
#: … at a place that is away from its end by less than this share of the distance to other points.
_NEARER = 0.5
#: Nearest points, whose mean motion is that of the track while it is lost.
_NEIGHBOURS = 2


def with_whole_tracks(capture: Capture) -> Capture:
    """With tracks of one marker that was lost and found under a new name as one point.

    Their names differ in numbers only, one ends before the other begins, and no third point is
    near: then the columns of the first have the places of both.
    """
    points = [p for p in contents(capture).points if not p.on_gripper]
    while (pair := _continued(capture, points)) is not None:
        first, second = pair
        values = capture.values.copy()
        places = np.array([capture.names.index(c) for c in first.columns])
        more = capture.at(second.columns)
        seen = np.isfinite(more).all(axis=1)
        values[np.ix_(np.flatnonzero(seen), places)] = more[seen]
        gone = set(second.columns)
        kept = [i for i, name in enumerate(capture.names) if name not in gone]
        note = f"{capture.path}: {second.name!r} begins where {first.name!r} ends: it is one marker"
        capture = replace(
            capture,
            columns=tuple(capture.columns[i] for i in kept),
            values=values[:, kept],
            notes=(*capture.notes, note),
        )
        points.remove(second)
    return capture


def _continued(capture: Capture, points: Sequence[Point]) -> tuple[Point, Point] | None:
    """A track and the one that goes on with it; None = there is none."""
    raw = {p.name: capture.at(p.columns) for p in points}
    rows = {n: np.flatnonzero(np.isfinite(r).all(axis=1)) for n, r in raw.items()}
    for first, second in permutations(points, 2):
        before, after = rows[first.name], rows[second.name]
        alike = re.sub(r"\d+", "", first.name) == re.sub(r"\d+", "", second.name)
        if not alike or len(first.columns) != len(second.columns) or not len(before):
            continue
        if not len(after) or not 0 < after[0] - before[-1] <= _GAP_ROWS:
            continue
        others = [raw[p.name] for p in points if p not in (first, second)]
        if _near(raw[first.name], raw[second.name], others, (int(before[-1]), int(after[0]))):
            return first, second
    return None


def _near(
    first: FloatArray, second: FloatArray, others: Sequence[FloatArray], rows: tuple[int, int]
) -> bool:
    """Whether a track goes on with the second, moved as the points next to it were meanwhile.

    rows  the last one of the first track, and the first one of the second
    """
    end, begin = rows
    alike = [o for o in others if o.shape[1] == first.shape[1] == second.shape[1]]
    there = [o for o in alike if np.isfinite(o[end] + o[begin]).all()]
    if not there:
        return False
    from_end = np.array([np.linalg.norm(o[end] - first[end]) for o in there])
    from_begin = np.array([np.linalg.norm(o[begin] - second[begin]) for o in there])
    moved = np.array([o[begin] - o[end] for o in there])
    expected = moved[np.argsort(from_end)[:_NEIGHBOURS]].mean(axis=0)
    away = float(np.linalg.norm(second[begin] - first[end] - expected))
    return away < _NEARER * float(min(from_end.min(), from_begin.min()))


_COORDINATES = (ColumnKind.COORDINATE,)
_VISIBLE = frozenset(("v", "vis", "visibility"))


def without_hidden(capture: Capture) -> Capture:
    """Without places for which a column of visibility, 1 or 0, has a 0.

    It belongs to the point of its name, else to the one in the columns before it.
    """
    kinds = [meaning(c) for c in capture.columns]
    values, notes = capture.values.copy(), list(capture.notes)
    for index, column in enumerate(capture.columns):
        words = re.split(r"[^a-z0-9]+|_", column.name.lower())
        shown = capture.values[:, index]
        if words[-1] not in _VISIBLE or set(np.unique(shown)) != {0.0, 1.0}:
            continue
        places, group = [], None
        for before in range(index - 1, -1, -1):
            if kinds[before].kind not in _COORDINATES or group not in (None, kinds[before].group):
                break
            group = kinds[before].group
            places.append(before)
        named = " ".join(words[:-1])
        own = [i for i, m in enumerate(kinds) if m.kind in _COORDINATES and m.group == named]
        places = own or places
        hidden = shown == 0.0
        if len(places) < 2:
            continue
        values[np.ix_(np.flatnonzero(hidden), np.array(places))] = np.nan
        point = kinds[places[0]].group
        count = int(np.count_nonzero(hidden))
        notes.append(
            f"{capture.path}: {column.name!r} is 0 in {count} rows: {point!r} was not seen there"
        )
    return replace(capture, values=values, notes=tuple(notes))


#: Share of a point's places that are held for as many rows each; a sensor at rest has no such rows.
_REGULAR = 0.8
_FEWEST = 10


def without_held(capture: Capture) -> Capture:
    """The file without places that a program repeats until the next one is measured.

    A point's places are held if each stands in as many rows, two at least, all over the file.
    """
    values, held = capture.values, dict[int, list[str]]()
    for point in contents(capture).points:
        columns = [capture.names.index(name) for name in point.columns]
        places = capture.values[:, columns]
        new = np.append(True, np.any(np.diff(places, axis=0) != 0.0, axis=1))
        begins = np.flatnonzero(new)
        if len(begins) < _FEWEST or len(begins) * 2 > len(places):
            continue
        rows, count = Counter(np.diff(begins).tolist()).most_common(1)[0]
        if rows < 2 or count < _REGULAR * (len(begins) - 1):
            continue
        values = values.copy() if values is capture.values else values
        values[np.ix_(~new, np.array(columns))] = np.nan
        held.setdefault(rows, []).append(point.name)
    told = [
        f"{capture.path}: each place of {first_of(names, 3)} stands in {rows} rows: it is measured "
        "in the first, and only held in the others, which are not read"
        for rows, names in held.items()
    ]
    return replace(capture, values=values, notes=(*capture.notes, *told))
