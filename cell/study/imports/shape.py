"""Shape of a chain of points: frames at rest, order of points, arc lengths, direction."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from cell.cable.arrays import FloatArray
from cell.study.series import first_lasting, noise_m, span_m

Ends = Literal["not-a-knot", "natural"]

#: A chain has begun to move when a point is this share of the chain's length from where it was …
AWAY = 0.02
#: … and this many times its noise, for so many rows.
OF_NOISE, STAYS = 8.0, 3
#: Rows before which nothing may be said of a rest.
FEWEST_REST = 5
#: A row is still at rest whose farthest point is so many times as far from where it rests as usual.
_QUIET = 2.0
#: Of the usual distance between neighbours; nearer ones are at one place.
_COINCIDES = 0.05
#: Shapes of which lengths are the median, and samples of each piece between two points.
_SHAPES, _SAMPLES = 200, 16


def rest_rows(places: FloatArray) -> slice:
    """Rows from the first on in which no point moves; empty if it moves from the beginning on.

    places  (rows, points, 2 or 3), nan = not seen; rows that show no point do not count
    """
    shown = _shown(places)
    begin = _begin(places[shown])
    return _up_to(shown, begin if begin >= FEWEST_REST else 0, len(places))


def still_rows(places: FloatArray) -> slice:
    """The rows at rest, without the last ones, in which a slow motion may have begun.

    A motion begins slowly: as many rows again are left out as show it beyond their noise.
    """
    shown = _shown(places)
    seen = places[shown]
    begin = _begin(seen)
    if begin < FEWEST_REST or begin == len(seen):
        return _up_to(shown, begin if begin >= FEWEST_REST else 0, len(places))
    away = np.linalg.norm(seen[:begin] - middle(seen[:begin]), axis=2)
    farthest = np.nan_to_num(away).max(axis=1)
    quiet = np.flatnonzero(farthest <= _QUIET * np.median(farthest))
    begins = int(quiet[-1]) + 1
    return _up_to(shown, max(2 * begins - begin, FEWEST_REST), len(places))


def _shown(places: FloatArray) -> NDArray[np.intp]:
    """Rows that show a point; all, if none does."""
    shown = np.flatnonzero(np.isfinite(places).any(axis=(1, 2)))
    return shown if len(shown) else np.arange(len(places))


def _up_to(shown: NDArray[np.intp], count: int, rows: int) -> slice:
    """The rows before that of the shown ones with number `count`."""
    return slice(0, rows if count >= len(shown) else int(shown[count]) if count else 0)


def resting(places: FloatArray) -> FloatArray | None:
    """(rows, points, d) positions at rest that show every point at least once; else None."""
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
    noise = float(np.nan_to_num(noise_m(places[: 4 * FEWEST_REST])))
    limit = max(AWAY * float(extent), OF_NOISE * noise)
    far = np.nan_to_num(away).max(axis=1) > limit
    begin = first_lasting(far, STAYS)
    return len(places) if begin is None else begin


def reach_of(places: FloatArray, cut: float = 0.0) -> float:
    """Span of positions (rows, d), over rows with all coordinates; nan if there are none.

    cut  share of the smallest and of the largest values that do not count
    """
    return span_m(places[np.isfinite(places).all(axis=1)], cut)


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
    every = _chords(shape)
    kept = _apart(every)
    at = every[kept]
    fine = np.concatenate(
        [np.linspace(a, b, _SAMPLES, endpoint=False) for a, b in pairwise(at)] + [at[-1:]]
    )
    curve = CubicSpline(at, shape[kept], bc_type=ends)
    steps = np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(steps)])[::_SAMPLES]
    return np.asarray(np.interp(every, at, lengths))


def _apart(at: FloatArray) -> list[int]:
    """Points that do not coincide with the one before, by their distances along straight pieces.

    Between a marker at the gripping point and the gripper noise alone makes a curve.
    """
    least = _COINCIDES * float(np.median(np.diff(at))) if len(at) > 1 else 0.0
    kept = [0]
    for i in range(1, len(at)):
        if at[i] - at[kept[-1]] > least:
            kept.append(i)
    return kept if kept[-1] == len(at) - 1 else [*(kept[:-1] or kept), len(at) - 1]


def root_direction(shape: FloatArray) -> FloatArray:
    """(d,) unit vector in which a cable (points, d) leaves its first point."""
    shape = distinct_points(shape)
    at = _chords(shape)
    tangent: FloatArray = CubicSpline(at, shape)(0.0, 1)
    return np.asarray(tangent / np.linalg.norm(tangent))


def distinct_points(shape: FloatArray) -> FloatArray:
    """(points, d) shape without points that coincide with the one before them.

    Between such points, a marker at the gripping point and the gripper for instance, noise alone
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
    pieces = np.diff(distinct_points(shape), axis=0)
    lengths = np.linalg.norm(pieces, axis=1, keepdims=True)
    pieces = (pieces / np.where(lengths > 0.0, lengths, 1.0))[lengths[:, 0] > 0.0]
    return np.asarray(pieces[-1] - pieces[0] if len(pieces) else np.zeros(shape.shape[1]))


def _chords(shape: FloatArray) -> FloatArray:
    """Distances along straight pieces between points; those that coincide are kept apart."""
    steps = np.linalg.norm(np.diff(shape, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-9 + 1e-9 * steps.sum()))])


#: A point that is lost jumps by so many of the longest steps that it makes otherwise, of which so
#: many may be wrong samples.
_JUMP, _WRONG = 3.0, 2
#: Where a point never comes nearer to a value than this share of its own way, the value is none of
#: its places.
_NEVER_NEAR = 0.5


def means_lost(value: float, raw: FloatArray) -> bool:
    """Whether a value in all coordinates of a point (rows, d) marks that it was not seen.

    A place that is passed, or at which a point rests before or after its motion, is no such.
    """
    there = np.all(raw == value, axis=1)
    rest = raw[~there & np.isfinite(raw).all(axis=1)]
    if not there.any() or len(rest) < FEWEST_REST:
        return False
    span = np.ptp(rest, axis=0).max()
    if np.linalg.norm(rest - value, axis=1).min() > _NEVER_NEAR * span:
        return True
    seen = np.flatnonzero(np.isfinite(raw).all(axis=1))
    both_sides = not there[seen[0]] and not there[seen[-1]]
    return bool(both_sides and _jumps(raw, value, there)[there].all())


def lost_rows(raw: FloatArray, values: Sequence[float], of_hand: bool) -> NDArray[np.bool_]:
    """(rows,) whether all coordinates of a point (rows, d) equal one value that means "lost".

    of_hand  a gripper may rest at a value that means that a marker was lost, such as 0: of it only
             those rows count to which it jumps and from which it jumps back
    """
    lost = np.zeros(len(raw), dtype=bool)
    for value in values:
        there = np.all(raw == value, axis=1)
        lost |= _jumps(raw, value, there) if of_hand else there
    return lost


def _jumps(raw: FloatArray, value: float, there: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those of the rows between which and the rows beside them a point jumps."""
    known = np.flatnonzero(~there & np.isfinite(raw).all(axis=1))
    if not there.any() or not len(known):
        return np.zeros(len(raw), dtype=bool)
    steps = np.linalg.norm(np.diff(raw[known], axis=0), axis=1)[np.diff(known) == 1]
    usual = float(np.sort(steps)[max(0, len(steps) - 1 - _WRONG)]) if len(steps) else 0.0
    away = np.linalg.norm(raw - value, axis=1)
    after = np.searchsorted(known, np.arange(len(raw)))
    beside = np.full((2, len(raw)), np.inf)
    beside[0, after > 0] = away[known[after[after > 0] - 1]]
    beside[1, after < len(known)] = away[known[after[after < len(known)]]]
    return np.asarray(there & (beside.min(axis=0) > _JUMP * usual))
