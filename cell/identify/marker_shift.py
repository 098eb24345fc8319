"""Derivatives of marker positions by arc length, and by the drift of the gripper."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.data import Trial

#: Rounds in which the spline takes its own length for the markers' places; points of a quadrature.
_ROUNDS, _POINTS = 3, 4
#: Markers that show the cable's line without the gripper.
ENOUGH = 5


def derivative_along(trial: Trial, arc_length_m: FloatArray) -> FloatArray:
    """(T, markers, 2) derivative of measured marker positions by arc length.

    Of the cubic spline through the markers of a frame, not bent at the last one, as at the end of a
    cable.  If they are few it begins at the gripping point, and leaves it along the clamp's angle;
    else these, which may be what is wrong, are left aside.  No cable is stretched: where both
    coordinates are seen, markers are placed by the length that the spline has between them, over
    all frames, for their stated arc lengths are wrong.  0 along a coordinate that is never seen.
    arc_length_m  (markers,) from the gripping point
    """
    from scipy.interpolate import CubicSpline  # half a second, for few studies

    t_s, grip, xy_m = trial.markers.t_s, trial.grip, trial.markers.xy_m
    x, y, angle = (np.interp(t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m, grip.angle_rad))
    ever = np.array(np.isfinite(xy_m).any(axis=0), dtype=np.bool_)
    leaves = -np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    slopes = np.where(ever, leaves[:, None], 0.0)
    hand_m = np.stack([x, y], axis=-1)
    flat, both = np.zeros((len(t_s), 2)), ever[:, 0] & ever[:, 1]
    for axes, seen in (([0], ever[:, 0]), ([1], ever[:, 1]), ([0, 1], both)):
        order = [m for m in np.argsort(arc_length_m) if seen[m]]
        points = [np.stack([_whole(t_s, xy_m[:, m, c]) for c in axes], axis=-1) for m in order]
        knots = arc_length_m[order]
        ends: list[Any] = ["not-a-knot", (2, flat[:, axes])]
        if len(order) < ENOUGH:
            order = [m for m in order if arc_length_m[m] > 0.0]
            knots = np.concatenate([[0.0], arc_length_m[order]])
            points = [hand_m[:, axes], *points[len(points) - len(order) :]]
            ends[0] = (1, leaves[:, axes])
        if not order:
            continue
        for _ in range(_ROUNDS if len(axes) == 2 else 1):
            curve = CubicSpline(knots, np.stack(points), bc_type=(ends[0], ends[1]))
            tangents = curve(knots, 1)[len(knots) - len(order) :]
            knots = _own_lengths(curve, knots)
        if len(axes) == 2:
            tangents = tangents / np.linalg.norm(tangents, axis=2, keepdims=True)
        for marker, tangent in zip(order, tangents, strict=True):
            slopes[:, marker, axes] = np.clip(tangent, -1.0, 1.0)
    return slopes


def carried_m(trial: Trial) -> FloatArray | None:
    """(shapes, T, markers, 2) shift of the markers by the gripper's drift; None = no drift.

    The gripper carries the whole cable with it: a drift is slower than a swing.  What it makes the
    cable swing beside that is found by simulation (`sampled_motions`).
    """
    drift, markers, grip = trial.hand_drift, trial.markers, trial.grip
    if drift is None:
        return None
    shapes_m = drift.shapes_m(markers.t_s, grip)
    carried = np.repeat(shapes_m[:, :, None], markers.xy_m.shape[1], axis=2)
    places_m = np.nan_to_num(markers.xy_m)
    if not drift.clamp_turns:
        hand_m = [np.interp(markers.t_s, grip.t_s, v) for v in (grip.x_m, grip.y_m)]
        places_m = np.broadcast_to(np.stack(hand_m, axis=-1)[:, None], places_m.shape)
    turned = [drift.turned_m(turn[:, None], places_m) for turn in drift.turns_rad(markers.t_s)]
    return np.concatenate([carried, np.reshape(turned, (-1, *places_m.shape))])


def _own_lengths(curve: Callable[[FloatArray, int], FloatArray], knots: FloatArray) -> FloatArray:
    """Knots as far apart as the curve is long between them, on average over frames."""
    at, weights = np.polynomial.legendre.leggauss(_POINTS)
    width = np.diff(knots)
    places = knots[:-1, None] + 0.5 * (1.0 + at) * width[:, None]
    stretch = np.linalg.norm(curve(places.ravel(), 1), axis=2).mean(axis=1).reshape(places.shape)
    lengths_m = np.cumsum(0.5 * width * (stretch @ weights))
    return np.asarray(knots[0] + np.concatenate([[0.0], lengths_m]))


def _whole(t_s: FloatArray, values_m: FloatArray) -> FloatArray:
    """Values with what was not seen interpolated."""
    seen = np.isfinite(values_m)
    return np.interp(t_s, t_s[seen], values_m[seen])
