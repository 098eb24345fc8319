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

#: A chain moves once a point is displaced by this fraction of the chain's length …
AWAY = 0.02
#: … and by this multiple of its noise, for so many rows.
OF_NOISE, STAYS = 8.0, 3
#: Minimum number of rows at rest.
FEWEST_REST = 5
#: Final share of a record whose median is a point's final position.
FINAL_SHARE = 0.3
#: Maximum displacement of the farthest point at rest, as a multiple of its median.
_MAX_REST = 2.0
#: Fraction of the median distance between neighbours below which points coincide.
_COINCIDENT = 0.05
#: Maximum number of shapes for a median length; samples of each piece between two points.
_MAX_SHAPES, _SAMPLES = 200, 16


def rest_rows(places: FloatArray) -> slice:
    """First rows, in which no point moves; empty if one moves from the beginning.

    places  (rows, points, 2 or 3), nan = not seen; rows that show no point do not count
    """
    visible = _visible_rows(places)
    start = _motion_start(places[visible])
    return _rows_before(visible, start if start >= FEWEST_REST else 0, len(places))


def still_rows(places: FloatArray) -> slice:
    """Rows at rest, without the last ones, in which a slow motion may have begun.

    As many rows are excluded before the last quiet row as lie between it and the detected motion.
    """
    visible = _visible_rows(places)
    positions = places[visible]
    start = _motion_start(positions)
    if start < FEWEST_REST or start == len(positions):
        return _rows_before(visible, start if start >= FEWEST_REST else 0, len(places))
    distance = np.linalg.norm(positions[:start] - middle(positions[:start]), axis=2)
    farthest = np.nan_to_num(distance).max(axis=1)
    quiet_rows = np.flatnonzero(farthest <= _MAX_REST * np.median(farthest))
    quiet_end = int(quiet_rows[-1]) + 1
    return _rows_before(visible, max(2 * quiet_end - start, FEWEST_REST), len(places))


def _visible_rows(places: FloatArray) -> NDArray[np.intp]:
    """Rows that show a point; all, if none does."""
    visible = np.flatnonzero(np.isfinite(places).any(axis=(1, 2)))
    return visible if len(visible) else np.arange(len(places))


def _rows_before(visible: NDArray[np.intp], count: int, rows: int) -> slice:
    """Rows before the visible row with index `count`."""
    return slice(0, rows if count >= len(visible) else int(visible[count]) if count else 0)


def resting(places: FloatArray) -> FloatArray | None:
    """(rows, points, d) positions at rest that show every point at least once; else None."""
    for rows in (still_rows(places), rest_rows(places)):
        if np.isfinite(places[rows]).all(axis=2).any(axis=0).all():
            return places[rows]
    return None


def middle(places: FloatArray) -> FloatArray:
    """(…) medians over rows (rows, …) of visible values; nan where there are none."""
    visible = np.isfinite(places).any(axis=0)
    medians = np.full(places.shape[1:], np.nan)
    medians[visible] = np.nanmedian(places[:, visible], axis=0)
    return medians


def _motion_start(places: FloatArray) -> int:
    """First row from which a point stays away from its initial position; `len(places)` if none."""
    first = middle(places[:FEWEST_REST])
    distance = np.linalg.norm(places - first, axis=2)
    visible = first[np.isfinite(first).all(axis=1)]
    if not len(visible):
        return 0
    extent = np.ptp(visible, axis=0).max()
    noise = float(np.nan_to_num(noise_m(places[: 4 * FEWEST_REST])))
    limit = max(AWAY * float(extent), OF_NOISE * noise)
    displaced = np.nan_to_num(distance).max(axis=1) > limit
    start = first_lasting(displaced, STAYS)
    return len(places) if start is None else start


def reach_of(places: FloatArray, cut: float = 0.0) -> float:
    """Span of positions (rows, d), over rows with all coordinates; nan if there are none.

    cut  share of the smallest and of the largest values that do not count
    """
    return span_m(places[np.isfinite(places).all(axis=1)], cut)


def chain(places: FloatArray, start: int) -> list[int]:
    """Points (points, d) in the order in which a cable passes through them, from one end."""
    remaining = set(range(len(places))) - {start}
    order = [start]
    while remaining:
        current = places[order[-1]]
        nearest = min(remaining, key=lambda p: float(np.linalg.norm(places[p] - current)))
        order.append(nearest)
        remaining.remove(nearest)
    return order


def arc_lengths(places: FloatArray, ends: Ends = "not-a-knot") -> FloatArray:
    """(points,) arc lengths along the curve from the first point: medians over complete rows.

    places  (rows, points, d) in their order along the cable
    ends    end condition of the curve, as of `scipy.interpolate.CubicSpline`
    """
    complete = places[np.isfinite(places).all(axis=(1, 2))]
    if not len(complete):
        steps = middle(np.linalg.norm(np.diff(places, axis=1), axis=2))
        return np.concatenate([[0.0], np.cumsum(steps)])
    sample = complete[np.unique(np.linspace(0, len(complete) - 1, _MAX_SHAPES).astype(int))]
    return np.asarray(np.median([_lengths(shape, ends) for shape in sample], axis=0))


def _lengths(shape: FloatArray, ends: Ends) -> FloatArray:
    """Arc lengths of points (points, d) along a cubic spline through them."""
    chords = _chords(shape)
    # Between coincident points, such as gripper and first marker, a curve would follow noise.
    usual = float(np.median(np.diff(chords))) if len(chords) > 1 else 0.0
    distinct = _distinct(chords, _COINCIDENT * usual)
    knots = chords[distinct]
    fine = np.concatenate(
        [np.linspace(a, b, _SAMPLES, endpoint=False) for a, b in pairwise(knots)] + [knots[-1:]]
    )
    curve = CubicSpline(knots, shape[distinct], bc_type=ends)
    steps = np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)
    lengths = np.concatenate([[0.0], np.cumsum(steps)])[::_SAMPLES]
    return np.asarray(np.interp(chords, knots, lengths))


def _distinct(arcs: FloatArray, least: float) -> list[int]:
    """Indices of points that are farther than `least` from the one before, and the last one.

    arcs  (points,) cumulative chord lengths
    """
    indices = [0]
    for i in range(1, len(arcs)):
        if arcs[i] - arcs[indices[-1]] > least:
            indices.append(i)
    return indices if indices[-1] == len(arcs) - 1 else [*(indices[:-1] or indices), len(arcs) - 1]


def root_direction(shape: FloatArray) -> FloatArray:
    """(d,) unit vector in which a cable (points, d) leaves its first point."""
    shape = distinct_points(shape)
    lengths = _chords(shape)
    tangent: FloatArray = CubicSpline(lengths, shape)(0.0, 1)
    return np.asarray(tangent / np.linalg.norm(tangent))


def distinct_points(shape: FloatArray) -> FloatArray:
    """(points, d) shape without points that coincide with the one before them.

    Between such points, for instance a marker at the gripping point and the gripper, the
    direction is noise.  The last point is always included.
    """
    lengths = _chords(shape)
    return shape[_distinct(lengths, AWAY * float(lengths[-1]))]


def bend(shape: FloatArray) -> FloatArray:
    """(d,) change of direction from a chain's first piece to its last; zero if it has one piece."""
    pieces = np.diff(distinct_points(shape), axis=0)
    lengths = np.linalg.norm(pieces, axis=1, keepdims=True)
    pieces = (pieces / np.where(lengths > 0.0, lengths, 1.0))[lengths[:, 0] > 0.0]
    return np.asarray(pieces[-1] - pieces[0] if len(pieces) else np.zeros(shape.shape[1]))


def _chords(shape: FloatArray) -> FloatArray:
    """Cumulative chord lengths of points; they increase even where points coincide."""
    steps = np.linalg.norm(np.diff(shape, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-9 + 1e-9 * steps.sum()))])


#: A lost point jumps by this multiple of its longest other step; number of longest steps that are
#: ignored as outliers.
_JUMP_RATIO, _OUTLIERS = 3.0, 2
#: A value to which a point never comes nearer than this fraction of its span is not one of its
#: positions.
_MIN_DISTANCE = 0.5


def means_lost(value: float, raw: FloatArray) -> bool:
    """Whether a value in all coordinates of a point (rows, d) marks that it was not seen.

    A position that a point passes, or at which it rests before or after its motion, is not.
    """
    equal = np.all(raw == value, axis=1)
    others = raw[~equal & np.isfinite(raw).all(axis=1)]
    if not equal.any() or len(others) < FEWEST_REST:
        return False
    span = np.ptp(others, axis=0).max()
    if np.linalg.norm(others - value, axis=1).min() > _MIN_DISTANCE * span:
        return True
    visible = np.flatnonzero(np.isfinite(raw).all(axis=1))
    both_sides = not equal[visible[0]] and not equal[visible[-1]]
    return bool(both_sides and _jumps(raw, value, equal)[equal].all())


def lost_rows(raw: FloatArray, values: Sequence[float], of_hand: bool) -> NDArray[np.bool_]:
    """(rows,) whether all coordinates of a point (rows, d) equal one value that means "lost".

    of_hand  the point is the gripper's, which may rest at such a value, for instance 0: only rows
             count to which it jumps and from which it jumps back
    """
    lost = np.zeros(len(raw), dtype=bool)
    for value in values:
        equal = np.all(raw == value, axis=1)
        lost |= _jumps(raw, value, equal) if of_hand else equal
    return lost


def _jumps(raw: FloatArray, value: float, equal: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(rows,) those of the rows equal to `value` that a point reaches and leaves by a jump."""
    valid = np.flatnonzero(~equal & np.isfinite(raw).all(axis=1))
    if not equal.any() or not len(valid):
        return np.zeros(len(raw), dtype=bool)
    steps = np.linalg.norm(np.diff(raw[valid], axis=0), axis=1)[np.diff(valid) == 1]
    longest = float(np.sort(steps)[max(0, len(steps) - 1 - _OUTLIERS)]) if len(steps) else 0.0
    distance = np.linalg.norm(raw - value, axis=1)
    after = np.searchsorted(valid, np.arange(len(raw)))
    neighbours = np.full((2, len(raw)), np.inf)
    neighbours[0, after > 0] = distance[valid[after[after > 0] - 1]]
    neighbours[1, after < len(valid)] = distance[valid[after[after < len(valid)]]]
    return np.asarray(equal & (neighbours.min(axis=0) > _JUMP_RATIO * longest))
