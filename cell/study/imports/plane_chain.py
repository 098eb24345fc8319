"""The cable's points in the study's plane: shape at rest, arc lengths, and the root's direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture
from cell.study.imports.choosing import Chosen, detected_places
from cell.study.imports.clamp_angle import Root
from cell.study.imports.contents import Point
from cell.study.imports.gripper_section import AxesSection
from cell.study.imports.places import angle_of
from cell.study.imports.shape import arc_lengths, middle, resting, root_direction
from cell.study.imports.trials import Files
from cell.study.series import wrapped

#: Maximum rows of a trial in which the direction of the cable's root is estimated.
_MAX_ROWS = 1000
#: Number of points that determine a line without a bend; minimum for extrapolating a curve.
A_LINE, _MIN_CURVE = 2, 3


@dataclass(frozen=True)
class PlaneChain:
    """The chain of points in the study's plane.

    xy_m          (rows, points, 2), the gripping point first where it is in the same file
    arcs          (markers,) from the gripping point, m
    shape         (points, 2) at rest, the gripping point first where that is known
    from_gripper  whether it is known; else arcs start at the first marker
    """

    xy_m: FloatArray
    arcs: FloatArray
    shape: FloatArray
    from_gripper: bool


def scene_of(
    raw: FloatArray, axes: AxesSection, scale: float, rest: FloatArray | None, with_hand: bool
) -> PlaneChain:
    """The chain in the plane.

    rest       (d,) rest position of the gripper of another file; None = unknown
    with_hand  the first of the points is the gripping point
    """
    directions = np.array([axes.right, axes.up])
    xy_m = raw @ directions.T * scale
    shape = shape_at_rest(xy_m)
    if rest is not None:
        shape = np.vstack([directions @ rest * scale, shape])
    # From the mean shape at rest: noise lengthens the curve through points of a single row.
    at_rest = resting(xy_m) is not None and np.isfinite(shape).all()
    lengths = arc_lengths(shape[None] if at_rest or rest is not None else xy_m)
    arcs = lengths[1:] if with_hand or rest is not None else lengths
    # The sag between a gripper and one marker is unknown, as is where a gripper elsewhere is.
    return PlaneChain(xy_m, arcs, shape, with_hand or (rest is not None and len(shape) > A_LINE))


def detected_points(capture: Capture, points: Sequence[Point], chosen: Chosen) -> FloatArray:
    """(rows, points, d) detected positions of points, in the file's unit and axes."""
    of_hand = (chosen.gripper, chosen.second, chosen.clamp)
    return np.stack(
        [detected_places(capture, p.columns, chosen.lost, of_hand=p in of_hand) for p in points],
        axis=1,
    )


def shape_at_rest(raw: FloatArray) -> FloatArray:
    """(points, d) median shape at rest, else of all visible positions."""
    rest = resting(raw)
    return middle(raw if rest is None else rest)


def shapes_of(trials: Sequence[Files], points: Sequence[Point], chosen: Chosen) -> list[FloatArray]:
    """(points, d) shapes at rest of the trials whose files have the same columns."""
    required = {name for p in points for name in p.columns}
    captures = [t.capture for t in trials if required <= set(t.capture.names)]
    shapes = [shape_at_rest(detected_points(c, points, chosen)) for c in captures]
    return [s for s in shapes if np.isfinite(s).all()]


def root_at_rest(scene: PlaneChain, arcs: Sequence[float | None]) -> Root:
    """Clamp angle from the markers at rest; if the first is away from the gripper, the curve is
    extrapolated to it.

    The error is estimated by a curve without the second point: it grows with the power of the
    distance that is the curve's order.
    """
    shape = scene.shape
    is_line, error_rad = len(shape) <= A_LINE, 0.0
    if (curve := curve_from_gripper(scene, arcs)) is not None:
        angle = angle_of(curve(0.0, 1))
        coarse = CubicSpline(np.delete(curve.x, 1), np.delete(shape, 1, axis=0))
        error_rad = abs(wrapped(angle - angle_of(coarse(0.0, 1))))
    else:
        angle = angle_of(root_direction(shape)) if len(shape) > 1 else 0.0
        if not is_line:
            coarse_rad = angle_of(root_direction(np.delete(shape, 1, axis=0)))
            order = min(3, len(shape) - 1)
            error_rad = abs(wrapped(angle - coarse_rad)) / (2.0**order - 1.0)
    return Root(np.full(1, np.nan), angle, is_line, error_rad)


def root_in_rows(scene: PlaneChain) -> FloatArray:
    """(rows,) clamp angle from the cable's root in some of the rows, else nan."""
    angle = np.full(len(scene.xy_m), np.nan)
    complete = np.flatnonzero(np.isfinite(scene.xy_m).all(axis=(1, 2)))
    complete = complete[:: max(1, len(complete) // _MAX_ROWS)]
    angle[complete] = np.unwrap([angle_of(root_direction(s)) for s in scene.xy_m[complete]])
    return angle


def roots_of_others(
    trials: Sequence[Files], chosen: Chosen, axes: AxesSection, arcs: Sequence[float | None]
) -> tuple[tuple[Capture, float], ...]:
    """Gripper file of each other trial, and the clamp angle from its markers at rest; trials that
    begin in motion, or whose file has other columns, are skipped."""
    points = [*([chosen.gripper] if chosen.gripper else []), *chosen.markers]
    required = {name for p in points for name in p.columns}
    roots = []
    for files in trials[1:]:
        if not required <= set(files.capture.names) or len(points) < A_LINE:
            continue
        raw = detected_points(files.capture, points, chosen)
        scene = scene_of(raw, axes, 1.0, None, chosen.gripper is not None)
        if resting(raw) is not None and np.isfinite(scene.shape).all():
            rest_rad = root_at_rest(scene, arcs).rest_rad
            roots.append((files.gripper or files.capture, rest_rad))
    return tuple(roots)


def curve_from_gripper(scene: PlaneChain, arcs: Sequence[float | None]) -> CubicSpline | None:
    """(2,) position against arc length, extrapolated to the gripper; None if the first marker is at
    the gripper, or there are too few markers."""
    known = [a for a in arcs if a is not None]
    if scene.from_gripper or len(known) < _MIN_CURVE or len(known) != len(scene.shape):
        return None
    return CubicSpline(known, scene.shape)


def start_of(curve: CubicSpline) -> tuple[FloatArray, float]:
    """(2,) position at arc length 0, and its error, m: the change by a curve without the second
    point."""
    coarse = CubicSpline(np.delete(curve.x, 1), np.delete(curve(curve.x), 1, axis=0))
    return curve(0.0), float(np.linalg.norm(curve(0.0) - coarse(0.0)))
