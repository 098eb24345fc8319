"""Shape of a chain of points: when at rest, in what order, how far along, in which direction."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.arrays import FloatArray

Ends = Literal["not-a-knot", "natural"]

#: A chain has begun to move when a point is this share of the chain's length from where it was …
AWAY = 0.02
#: … and this many times its noise, for so many rows.
OF_NOISE, STAYS = 8.0, 3
#: Rows before which nothing may be said of a rest.
FEWEST_REST = 5
#: A row is still at rest whose farthest point is so many times as far from where it rests as usual.
_QUIET = 2.0
#: Shapes of which lengths are the median, and samples of each piece between two points.
_SHAPES, _SAMPLES = 200, 16


def rest_rows(places: FloatArray) -> slice:
    """Rows from the first on in which no point moves; empty if it moves from the beginning on.

    places  (rows, points, 2 or 3), nan = not seen
    """
    begin = _begin(places)
    return slice(0, begin if begin >= FEWEST_REST else 0)


def still_rows(places: FloatArray) -> slice:
    """Rows at rest without those in which a motion already begins, below what `rest_rows` sees.

    A motion begins slowly: as many rows again are left out as show it beyond their noise.
    """
    rest = rest_rows(places)
    if rest.stop in (0, len(places)):
        return rest
    away = np.linalg.norm(places[rest] - middle(places[rest]), axis=2)
    farthest = np.nan_to_num(away).max(axis=1)
    quiet = np.flatnonzero(farthest <= _QUIET * np.median(farthest))
    begins = int(quiet[-1]) + 1
    return slice(0, max(2 * begins - rest.stop, FEWEST_REST))


def resting(places: FloatArray) -> FloatArray | None:
    """Rows at rest, in which every point is seen at least once; None if there are none."""
    for rows in (still_rows(places), rest_rows(places)):
        if np.isfinite(places[rows]).all(axis=2).any(axis=0).all():
            return places[rows]
    return None


def middle(places: FloatArray) -> FloatArray:
    """(…) medians over rows (rows, …) of what is seen; nan where nothing is."""
    seen = np.isfinite(places).any(axis=0)
    found = np.full(places.shape[1:], np.nan)
    found[seen] = np.nanmedian(places[:, seen], axis=0)
    return found


def _begin(places: FloatArray) -> int:
    """First row from which a point stays away from where it was; all rows if none does."""
    first = middle(places[:FEWEST_REST])
    away = np.linalg.norm(places - first, axis=2)
    seen = first[np.isfinite(first).all(axis=1)]
    if not len(seen):
        return 0
    extent = np.ptp(seen, axis=0).max()
    bends = np.abs(np.diff(places[: 4 * FEWEST_REST], 2, axis=0)) / np.sqrt(6.0)
    noise = 1.4826 * float(np.nanmedian(bends)) if np.isfinite(bends).any() else 0.0
    limit = max(AWAY * float(extent), OF_NOISE * noise)
    far = np.nan_to_num(away).max(axis=1) > limit
    ahead = np.concatenate([far, np.repeat(far[-1:], STAYS - 1)])
    stays = np.lib.stride_tricks.sliding_window_view(ahead, STAYS).all(axis=1)
    return int(np.argmax(stays)) if stays.any() else len(places)


def chain(places: FloatArray, start: int) -> list[int]:
    """Points (points, d) in the order in which a cable passes through them, from one end."""
    left = set(range(len(places))) - {start}
    order = [start]
    while left:
        here = places[order[-1]]
        nearest = min(left, key=lambda p: float(np.linalg.norm(places[p] - here)))
        order.append(nearest)
        left.remove(nearest)
    return order


def arc_lengths(places: FloatArray, ends: Ends = "not-a-knot") -> FloatArray:
    """(points,) along the curve from the first point on: medians over rows that show all.

    places  (rows, points, d) in their order along the cable
    ends    how the curve is bent there, as of `scipy.interpolate.CubicSpline`
    """
    whole = places[np.isfinite(places).all(axis=(1, 2))]
    if not len(whole):
        steps = middle(np.linalg.norm(np.diff(places, axis=1), axis=2))
        return np.concatenate([[0.0], np.cumsum(steps)])
    some = whole[np.unique(np.linspace(0, len(whole) - 1, _SHAPES).astype(int))]
    return np.asarray(np.median([_lengths(shape, ends) for shape in some], axis=0))


def _lengths(shape: FloatArray, ends: Ends) -> FloatArray:
    """Arc lengths of points (points, d) of a cubic through them."""
    at = _chords(shape)
    fine = np.concatenate(
        [np.linspace(a, b, _SAMPLES, endpoint=False) for a, b in pairwise(at)] + [at[-1:]]
    )
    curve = CubicSpline(at, shape, bc_type=ends)
    steps = np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])[::_SAMPLES]


def root_direction(shape: FloatArray) -> FloatArray:
    """(d,) unit vector in which a cable (points, d) leaves its first point."""
    shape = apart(shape)
    at = _chords(shape)
    tangent: FloatArray = CubicSpline(at, shape)(0.0, 1)
    return np.asarray(tangent / np.linalg.norm(tangent))


def apart(shape: FloatArray) -> FloatArray:
    """(points, d) without those that lie where the one before them does.

    Between such points, a marker at the gripping point and the hand for instance, noise alone
    makes a direction.  The last point is kept.
    """
    at = _chords(shape)
    kept = [0]
    for i in range(1, len(shape)):
        if at[i] - at[kept[-1]] > AWAY * at[-1]:
            kept.append(i)
    if kept[-1] != len(shape) - 1:
        kept = [*(kept[:-1] if len(kept) > 1 else kept), len(shape) - 1]
    return shape[kept]


def bend(shape: FloatArray) -> FloatArray:
    """(d,) change of direction from a chain's first piece to its last; zero if there is one."""
    pieces = np.diff(apart(shape), axis=0)
    lengths = np.linalg.norm(pieces, axis=1, keepdims=True)
    pieces = (pieces / np.where(lengths > 0.0, lengths, 1.0))[lengths[:, 0] > 0.0]
    return np.asarray(pieces[-1] - pieces[0] if len(pieces) else np.zeros(shape.shape[1]))


def _chords(shape: FloatArray) -> FloatArray:
    """Distances along straight pieces between points; those that coincide are kept apart."""
    steps = np.linalg.norm(np.diff(shape, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-9 + 1e-9 * steps.sum()))])
