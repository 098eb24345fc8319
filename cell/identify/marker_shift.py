"""Derivatives of marker positions by arc length, and by the drift of the gripper."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.data import Trial

#: Iterations of the markers' arc lengths by the spline's own length; points of the quadrature.
_ROUNDS, _POINTS = 3, 4
#: Markers that determine the cable's line without the gripper.
ENOUGH = 5


def derivative_along(trial: Trial, arc_length_m: FloatArray) -> FloatArray:
    """(T, markers, 2) derivative of measured marker positions by arc length.

    It is that of the cubic spline through the markers of a frame, straight at the last one, like a
    cable's end.  With few markers it begins at the gripping point, along the clamp angle; with
    `ENOUGH` these are not used, as they may be wrong.  Where both coordinates are observed, markers
    are placed by the spline's length between them, averaged over frames: a cable does not stretch,
    and stated arc lengths are uncertain.  0 along a coordinate that is never observed.
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
    for axes, observed in (([0], ever[:, 0]), ([1], ever[:, 1]), ([0, 1], both)):
        order = [m for m in np.argsort(arc_length_m) if observed[m]]
        points = [np.stack([_filled(t_s, xy_m[:, m, c]) for c in axes], axis=-1) for m in order]
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

    The cable moves rigidly with the gripper, as a drift is slower than a swing.  The swing that it
    excites in addition is simulated (`sampled_motions`).
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
    """Knots at the curve's arc lengths, averaged over frames."""
    at, weights = np.polynomial.legendre.leggauss(_POINTS)
    width = np.diff(knots)
    places = knots[:-1, None] + 0.5 * (1.0 + at) * width[:, None]
    stretch = np.linalg.norm(curve(places.ravel(), 1), axis=2).mean(axis=1).reshape(places.shape)
    lengths_m = np.cumsum(0.5 * width * (stretch @ weights))
    return np.asarray(knots[0] + np.concatenate([[0.0], lengths_m]))


def _filled(t_s: FloatArray, values_m: FloatArray) -> FloatArray:
    """Values with missing ones interpolated."""
    observed = np.isfinite(values_m)
    return np.interp(t_s, t_s[observed], values_m[observed])
