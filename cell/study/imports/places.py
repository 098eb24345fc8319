"""Columns of a file as places in the study's plane, metres, and as clamp angles, radians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture
from cell.study.imports.gripper_section import AngleSection, AxesSection
from cell.study.imports.shape import lost_rows

#: Angles of either count of a turn, ±180° or 0 to 360°, are left as they are up to so much; what is
#: beyond lacks a whole turn.  It is far from all directions in which clamps usually point, rad.
_HALF_TURN = 1.25 * np.pi
#: A whole turn, with room for the digits of a unit.
_WHOLE_TURN = 2.001 * np.pi


def places_m(
    capture: Capture,
    columns: Sequence[str | None],
    axes: AxesSection,
    metres_per_unit: float,
    lost: Sequence[float] = (),
    unseen: float = np.nan,
    of_hand: bool = False,
) -> FloatArray:
    """(rows, 2) x (right) and y (up) of a point, nan where it is not seen.

    columns  null = this coordinate was not measured; it counts as `unseen`
    lost     values that all coordinates have where the point is not seen
    of_hand  it is one of the gripper, which may be at such a value
    raises   InputError: there is no such column
    """
    raw = np.full((len(capture.values), len(columns)), unseen)
    for k, name in enumerate(columns):
        if name is not None:
            raw[:, k] = capture.column(name)
    given = [k for k, name in enumerate(columns) if name is not None]
    raw[lost_rows(raw[:, given], lost, of_hand)] = np.nan
    return np.column_stack([_along(raw, axis) for axis in _square(axes)]) * metres_per_unit


def out_of_plane_m(
    capture: Capture,
    columns: Sequence[str | None],
    axes: AxesSection,
    metres_per_unit: float,
    lost: Sequence[float] = (),
) -> FloatArray | None:
    """(rows,) coordinate across the plane, nan where it is not seen; None where a point has two."""
    if len(columns) < 3 or None in columns:
        return None
    right, up = _square(axes)
    names = [name for name in columns if name is not None]
    raw = capture.at(names)
    across: FloatArray = raw @ np.cross(right, up) * metres_per_unit
    across[lost_rows(raw, lost, of_hand=False)] = np.nan
    return across


def clamp_angle_rad(capture: Capture, angle: AngleSection, axes: AxesSection) -> FloatArray | None:
    """(rows,) clamp angle; None where it is that of a line or of an arm that turns.

    0 = level, positive = pointing down; the cable leaves along (−cos, −sin).
    raises  InputError: there is no such column
    """
    if angle.constant_rad is not None:
        return np.full(len(capture.values), angle.constant_rad + angle.offset_rad)
    if angle.column is not None and angle.radians_per_unit is not None:
        turned: FloatArray = capture.column(angle.column) * angle.radians_per_unit
        return continuous(turned, angle.offset_rad)
    if angle.quaternion is not None and angle.body_axis is not None:
        leaving = body_axis(capture.at(angle.quaternion), angle.body_axis)
        right, up = (np.resize(v, 3) if len(v) == 3 else np.append(v, 0.0) for v in _square(axes))
        return continuous(_angle(leaving @ right, leaving @ up), angle.offset_rad)
    return None


def angle_towards(from_m: FloatArray, to_m: FloatArray, offset_rad: float = 0.0) -> FloatArray:
    """Clamp angle of a gripper whose cable leaves from one point (rows, 2) towards another."""
    direction = to_m - from_m
    return continuous(_angle(direction[:, 0], direction[:, 1]), offset_rad)


def continuous(angle_rad: FloatArray, offset_rad: float = 0.0) -> FloatArray:
    """(rows,) angles plus an offset, unwrapped, and shifted by whole turns to the principal range.

    Angles beyond ±2π are of no count of a turn, but of another unit: they stay as they are.
    """
    good = np.isfinite(angle_rad)
    known = angle_rad[good]
    found = angle_rad + offset_rad
    if not len(known) or np.abs(known).max() > _WHOLE_TURN:
        return found
    known = np.unwrap(known) + offset_rad
    middle = 0.5 * (known.min() + known.max())
    if abs(middle) > _HALF_TURN:
        known = known - 2.0 * np.pi * np.round(middle / (2.0 * np.pi))
    found[good] = known
    return found


def body_axis(quaternion: FloatArray, name: str) -> FloatArray:
    """(rows, 3) direction of a body's axis, such as `-x`; quaternions (rows, 4) x, y, z, w."""
    length = np.linalg.norm(quaternion, axis=1)
    good = np.isfinite(length) & (length > 0.5)
    found = np.full((len(quaternion), 3), np.nan)
    axis = np.zeros(3)
    axis["xyz".index(name[1])] = -1.0 if name[0] == "-" else 1.0
    if good.any():
        found[good] = Rotation.from_quat(quaternion[good]).apply(axis)
    return found


def angle_of(direction: FloatArray) -> float:
    """Clamp angle of one direction (2,) in which a cable leaves, rad."""
    return float(np.arctan2(-direction[1], -direction[0]))


def _angle(x: FloatArray, y: FloatArray) -> FloatArray:
    """Clamp angle of a direction in which a cable leaves, between −π and π."""
    return np.asarray(np.arctan2(-y, -x), dtype=np.float64)


def _square(axes: AxesSection) -> tuple[FloatArray, FloatArray]:
    """Both directions with length 1 and at a right angle, up kept."""
    up = np.array(axes.up) / np.linalg.norm(axes.up)
    right = np.array(axes.right) - (np.array(axes.right) @ up) * up
    return right / np.linalg.norm(right), up


def _along(raw: FloatArray, axis: FloatArray) -> FloatArray:
    """Component along an axis; a column across it may be missing."""
    used = np.abs(axis) > 0.0
    return np.asarray(raw[:, used] @ axis[used], dtype=np.float64)
