"""Rows of detections whose numbers a tracking program gives: lost points go on under new ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture
from cell.study.imports.choosing import from_end
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import Point

#: Words of columns with numbers that a program gives to what it follows, in each film anew.
_TRACK = frozenset(("track", "tid", "trajectory", "particle"))
#: Frames in which a point may be lost; what is seen in fewer is none; a still one moves less.
_MOST_LOST, _FEWEST_SHARE, _STILL = 12, 0.1, 0.02
#: A point is where it is expected within this share of the way to the next one.
_NEAR = 0.5


def along_cable(capture: Capture, time: int) -> tuple[Capture, Sequence[int]]:
    """The rows of points that move, numbered from the end that rests first; else unchanged.

    A track that begins next to where another one has ended, as its neighbour moved, goes on with
    it.  Rows without a number are left out; the second item is which are kept.
    """
    every = range(len(capture.values))
    of_track = next((i for i, c in enumerate(capture.columns)
                     if _TRACK & set(c.name.lower().replace("_", " ").split())), None)  # fmt: skip
    axes = {m.axis: i for i, c in reversed(list(enumerate(capture.columns)))
            if (m := meaning(c)).kind is ColumnKind.COORDINATE}  # fmt: skip
    if of_track is None or not {"x", "y"} <= set(axes):
        return capture, every
    ids = capture.values[:, of_track]
    known = np.isfinite(ids)
    times, frames = np.unique(capture.values[:, time], return_inverse=True)
    numbers = np.unique(ids[known])
    if not 2 <= len(numbers) <= len(times) or 2 * known.sum() < len(ids):
        return capture, every
    places = np.full((len(numbers), len(times), 2), np.nan)
    track = np.searchsorted(numbers, np.where(known, ids, numbers[0]))
    places[track[known], frames[known]] = capture.values[known][:, [axes["x"], axes["y"]]]
    if np.isfinite(places[..., 0]).sum() < known.sum():  # two rows of one track at one time
        return capture, every
    into = _joined_tracks(places)
    for i, first in enumerate(into):
        if first != i:
            places[first] = np.where(np.isfinite(places[i]), places[i], places[first])
    seen = np.isfinite(places[..., 0]).mean(axis=1)
    reach = [float(np.linalg.norm(np.ptp(p[np.isfinite(p[:, 0])], axis=0))) for p in places]
    good = (seen >= _FEWEST_SHARE) & (np.array(reach) > _STILL * max(reach))
    kept = [i for i, first in enumerate(into) if first == i and good[i]]
    if len(kept) < 2:
        return capture, every
    order = from_end([Point(str(i), (), "") for i in kept], {str(i): places[i] for i in kept})
    rank = {int(p.name): float(number) for number, p in enumerate(order, 1)}
    made = np.array([rank.get(into[i], np.nan) for i in track])
    rows = known & np.isfinite(made)
    values = capture.values.copy()
    values[:, of_track] = made
    left_out = len(rows) - int(rows.sum())
    ends = ", ".join(f"{numbers[i]:g} with {numbers[f]:g}" for i, f in enumerate(into) if f != i)
    note = f"{capture.path}: tracks are numbered along the cable, from the end that rests first"
    note += f"; those that go on under another number are joined: {ends}" if ends else ""
    note += f"; {left_out} rows of no track, or of one that is short or still, are left out"
    made_of = replace(capture, values=values[rows], lines=capture.lines[rows])
    return replace(made_of, notes=(*capture.notes, note)), np.flatnonzero(rows).tolist()


def _joined_tracks(places: FloatArray) -> list[int]:
    """Which track each one goes on with; itself if it begins by itself.

    places  (tracks, frames, 2), nan = not seen
    """
    seen = np.isfinite(places[..., 0])
    begins, ends = seen.argmax(axis=1), seen.shape[1] - 1 - seen[:, ::-1].argmax(axis=1)
    into = list(range(len(places)))
    for new in np.argsort(begins, kind="stable").tolist():
        gaps = [(o, int(begins[new] - ends[o])) for o in range(len(places))]
        old = [o for o, gap in gaps if 0 < gap <= _MOST_LOST and o not in _continued(into)]
        away = {o: _away(places, o, new, int(ends[o]), int(begins[new])) for o in old}
        others = [o for o in np.flatnonzero(seen[:, begins[new]]).tolist() if o != new]
        if not away or not others:
            continue
        best = min(away, key=lambda o: away[o])
        at = places[others, begins[new]] - places[new, begins[new]]
        if away[best] < _NEAR * float(np.linalg.norm(at, axis=1).min()):
            into[new] = best
    return [_first_of(into, i) for i in range(len(into))]


def _continued(into: Sequence[int]) -> set[int]:
    return {first for i, first in enumerate(into) if first != i}


def _first_of(into: Sequence[int], i: int) -> int:
    return i if into[i] == i else _first_of(into, into[i])


def _away(places: FloatArray, old: int, new: int, ended: int, begun: int) -> float:
    """How far a track begins from where another one would be, had it moved as its neighbour."""
    apart = np.linalg.norm(places[:, ended] - places[old, ended], axis=1)
    apart[old] = np.nan
    both = np.flatnonzero(np.isfinite(apart) & np.isfinite(places[:, begun, 0]))
    nearest = both[np.argmin(apart[both])] if len(both) else old
    moved = places[nearest, begun] - places[nearest, ended] if len(both) else np.zeros(2)
    return float(np.linalg.norm(places[old, ended] + moved - places[new, begun]))
