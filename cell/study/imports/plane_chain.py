"""The cable's points in the study's plane: shape at rest, arc lengths, and the root's direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.cable_root import (
    A_LINE,
    Root,
    RootEnds,
    root_of_shape,
)
from cell.study.imports.capture import Capture
from cell.study.imports.choosing import Chosen, detected_places
from cell.study.imports.contents import Point
from cell.study.imports.gripper_section import AxesSection
from cell.study.imports.places import angle_of
from cell.study.imports.shape import (
    FINAL_SHARE,
    arc_lengths,
    middle,
    resting,
    root_direction,
)
from cell.study.imports.trials import Files

#: Maximum rows of a trial in which the direction of the cable's root is estimated.
_MAX_ROWS = 1000


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
    """Clamp angle from the markers at rest."""
    return root_of_shape(scene.shape, arcs, scene.from_gripper)


def root_in_rows(scene: PlaneChain) -> FloatArray:
    """(rows,) clamp angle from the cable's root in some of the rows, else nan."""
    angle = np.full(len(scene.xy_m), np.nan)
    complete = np.flatnonzero(np.isfinite(scene.xy_m).all(axis=(1, 2)))
    complete = complete[:: max(1, len(complete) // _MAX_ROWS)]
    angle[complete] = np.unwrap([angle_of(root_direction(s)) for s in scene.xy_m[complete]])
    return angle


def root_ends(
    trials: Sequence[Files],
    points: Sequence[Point],
    chosen: Chosen,
    axes: AxesSection,
    arcs: Sequence[float | None],
) -> list[RootEnds | None]:
    """The cable's root at the beginning and the end of every trial; None for those that begin in
    motion, or whose file has other columns.

    points  of the cable in the markers' files, the gripping point first where that is known
    """
    required, plane = {name for p in points for name in p.columns}, np.array([axes.right, axes.up])
    ends: list[RootEnds | None] = []
    for files in trials:
        ends.append(None)
        if not required <= set(files.capture.names) or len(points) < A_LINE:
            continue
        xy = detected_points(files.capture, points, chosen) @ plane.T
        shapes = shape_at_rest(xy), middle(xy[int((1.0 - FINAL_SHARE) * len(xy)) :])
        if resting(xy) is None or not np.isfinite(shapes[0]).all():
            continue
        from_gripper = len(points) > len(arcs)
        roots = [root_of_shape(s, arcs, from_gripper) for s in shapes if np.isfinite(s).all()]
        last_rad = roots[1].rest_rad if len(roots) > 1 else np.nan
        std_rad = max(r.std_rad for r in roots)
        source = files.gripper or files.capture
        ends[-1] = RootEnds(source, roots[0].rest_rad, last_rad, std_rad)
    return ends
