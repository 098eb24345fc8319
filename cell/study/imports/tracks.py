"""Joins and numbers tracks of a tracking program, which gives lost points new numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.words import first_of
from cell.study.imports.cable_points import from_end
from cell.study.imports.capture import Capture
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import Point

#: Words in the names of columns with track numbers, which restart in each film.
_TRACK = frozenset(("track", "tid", "trajectory", "particle"))
#: Maximum frames without a point, minimum fraction of frames with it, minimum relative motion.
_MAX_LOST, _MIN_VISIBLE, _MIN_MOTION = 12, 0.1, 0.02
#: Tracks beyond so many are those of a film full of points.
_MAX_TRACKS = 1000
#: Maximum distance from the expected position, as a fraction of that to the next point.
_MAX_DISTANCE = 0.5


def along_cable(capture: Capture, time: int) -> tuple[Capture, Sequence[int]]:
    """Rows of moving points, numbered from the end that rests first; else unchanged.

    A track that begins near the end of another, moved as its neighbour, continues it.  Rows without
    a number are dropped; the second item is the indices of the retained rows.
    """
    all_rows = range(len(capture.values))
    column = next((i for i, c in enumerate(capture.columns)
                   if _TRACK & set(c.name.lower().replace("_", " ").split())), None)  # fmt: skip
    axes = {m.axis: i for i, c in reversed(list(enumerate(capture.columns)))
            if (m := meaning(c)).kind is ColumnKind.COORDINATE}  # fmt: skip
    if column is None or not {"x", "y"} <= set(axes):
        return capture, all_rows
    ids = capture.values[:, column]
    numbered = np.isfinite(ids)
    times, frames = np.unique(capture.values[:, time], return_inverse=True)
    numbers = np.unique(ids[numbered])
    if not 2 <= len(numbers) <= min(len(times), _MAX_TRACKS) or 2 * numbered.sum() < len(ids):
        return capture, all_rows
    places = np.full((len(numbers), len(times), 2), np.nan)
    track = np.searchsorted(numbers, np.where(numbered, ids, numbers[0]))
    places[track[numbered], frames[numbered]] = capture.values[numbered][:, [axes["x"], axes["y"]]]
    if np.isfinite(places[..., 0]).sum() < numbered.sum():  # two rows of one track at one time
        return capture, all_rows
    heads = joined_tracks(places, _MAX_LOST)
    for i, first in enumerate(heads):
        if first != i:
            places[first] = np.where(np.isfinite(places[i]), places[i], places[first])
    visible = np.isfinite(places[..., 0]).mean(axis=1)
    spans = [float(np.linalg.norm(np.ptp(p[np.isfinite(p[:, 0])], axis=0))) for p in places]
    valid = (visible >= _MIN_VISIBLE) & (np.array(spans) > _MIN_MOTION * max(spans))
    used = [i for i, first in enumerate(heads) if first == i and valid[i]]
    if len(used) < 2:
        return capture, all_rows
    order = from_end([Point(str(i), (), "") for i in used], {str(i): places[i] for i in used})
    rank = {int(p.name): float(number) for number, p in enumerate(order, 1)}
    renumbered = np.array([rank.get(heads[i], np.nan) for i in track])
    rows = numbered & np.isfinite(renumbered)
    values = capture.values.copy()
    values[:, column] = renumbered
    dropped = len(rows) - int(rows.sum())
    pairs = [f"{numbers[i]:g} with {numbers[f]:g}" for i, f in enumerate(heads) if f != i]
    note = f"{capture.path}: tracks are numbered along the cable, from the end that rests first"
    note += (
        f"; those that go on under another number are joined: {first_of(pairs, 8)}" if pairs else ""
    )
    note += f"; {dropped} rows of no track, or of one that is short or still, are left out"
    result = replace(capture, values=values[rows], lines=capture.lines[rows]).noted(note)
    return result, np.flatnonzero(rows).tolist()


def joined_tracks(
    places: FloatArray, most_lost: int, families: Sequence[str] | None = None
) -> list[int]:
    """Index of the first track that each track continues; its own index if it continues none.

    places     (tracks, frames, d), nan = not seen
    most_lost  maximum frames between the end of a track and its continuation
    families   of the tracks: only those of one family continue each other; None = all are of one
    """
    visible = np.asarray(np.isfinite(places).all(axis=2))
    begins, ends = visible.argmax(axis=1), visible.shape[1] - 1 - visible[:, ::-1].argmax(axis=1)
    heads = list(range(len(places)))
    continued: set[int] = set()
    for new in np.argsort(begins, kind="stable").tolist():
        gaps = begins[new] - ends
        ended = np.flatnonzero((gaps > 0) & (gaps <= most_lost)).tolist()
        old = [o for o in ended if o not in continued
               and (families is None or families[o] == families[new])]  # fmt: skip
        distances = {o: _distance(places, o, new, int(ends[o]), int(begins[new])) for o in old}
        others = [o for o in np.flatnonzero(visible[:, begins[new]]).tolist() if o != new]
        if not distances or not others:
            continue
        best = min(distances, key=lambda o: distances[o])
        offsets = places[others, begins[new]] - places[new, begins[new]]
        if distances[best] < _MAX_DISTANCE * float(np.linalg.norm(offsets, axis=1).min()):
            heads[new] = heads[best]  # which began before
            continued.add(best)
    return heads


def _distance(places: FloatArray, old: int, new: int, end: int, start: int) -> float:
    """Distance of a track's start from another's end, if that moved as its neighbour."""
    distances = np.linalg.norm(places[:, end] - places[old, end], axis=1)
    distances[old] = np.nan
    visible = np.flatnonzero(np.isfinite(distances) & np.isfinite(places[:, start, 0]))
    nearest = visible[np.argmin(distances[visible])] if len(visible) else old
    moved = places[nearest, start] - places[nearest, end] if len(visible) else 0.0
    return float(np.linalg.norm(places[old, end] + moved - places[new, start]))
