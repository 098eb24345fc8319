"""Estimates the study's plane from the motion; converts columns to positions, m, and angles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, Finding, ImportFindings, Sure
from cell.study.imports.gripper_section import AngleSection, AxesSection
from cell.study.imports.shape import bend, lost_rows, middle

#: A file axis is in the plane if its projection onto the plane is longer than this.
_IN_PLANE = 0.9
#: Minimum bend of the cable that determines up (1 = about a radian), and minimum ratio to the bend
#: along the default axis for choosing another one.
_MIN_BEND, _RATIO = 0.1, 1.5
#: Minimum bend for a guess, rad: 0.2 mm on a piece of 10 mm, by which markers are misplaced.
_SLIGHT_BEND = 0.02
#: Minimum cosine to the vertical of a cable that hangs straight at rest.
_HANGING = 0.9
#: Maximum angle to the file's axes of an aligned plane, rad: half a degree changes positions in the
#: plane by 4 parts in 100,000.
ALIGNED = 0.0087
#: Displacements show a plane if they reach this multiple of their extent out of it.
_PLANAR = 10.0
_LETTERS = "XYZ"


def find_axes(
    places: FloatArray, shape: FloatArray, others: Sequence[FloatArray] = ()
) -> tuple[AxesSection, ImportFindings]:
    """Directions of x (right) and y (up) of the study, such that the cable leaves towards −x.

    places  (rows, points, 2 or 3) in order along the cable, the gripper first
    shape   (points, d) of the cable at rest, or its mean
    others  shapes of the other trials
    """
    normal, depth = _normal(places)
    if normal is not None:
        shape, *others = (s - np.outer(s @ normal, normal) for s in (shape, *others))
    up, sure, why = _up(shape, others, normal)
    right, remark = _right(places, shape, normal, up)
    findings = ImportFindings()
    if normal is not None:
        findings.shown("axes", f"the motion is in one plane, {depth:.2g} of its size out of it")
    findings.append(Finding("axes.up", f"up is {_words(up)}: {why}", sure))
    sentence = f"right is {_words(right)}: so the cable leaves the gripper to the left{remark}"
    findings.shown("axes.right", sentence)
    plain = [[round(float(v), 7) + 0.0 for v in d] for d in (right, up)]
    return AxesSection(right=plain[0], up=plain[1]), findings


def _normal(places: FloatArray) -> tuple[FloatArray | None, float]:
    """Unit normal of the motion's plane, and its relative extent along it; None and 0 in 2D.

    Points may lie beside the plane, each at a depth of its own; a motion along a line does not show
    the plane, then that of all places is returned.
    """
    if places.shape[2] == 2:
        return None, 0.0
    visible = np.isfinite(places).all(axis=2)
    for about in (middle(places), np.median(places[visible], axis=0)):
        centred = (places - about)[visible]
        _, sizes, directions = np.linalg.svd(centred, full_matrices=False)
        if sizes[1] > _PLANAR * sizes[2]:
            break
    return directions[2], float(sizes[2] / sizes[0])


def _up(
    shape: FloatArray, others: Sequence[FloatArray], normal: FloatArray | None
) -> tuple[FloatArray, Sure, str]:
    """Up: the file axis against which the cable bends from its clamp on; how sure, and why."""
    dimensions = shape.shape[1]
    axes = list(range(dimensions))
    if normal is not None:  # if the plane is oblique to all axes, the one nearest to it
        in_plane = np.sqrt(1.0 - np.minimum(1.0, normal**2)) > _IN_PLANE
        axes = [k for k in axes if in_plane[k]] or [int(np.argmin(np.abs(normal)))]
    default = next(k for k in (2, 1, 0) if k in axes)
    mean_bend = np.mean([bend(s) for s in (shape, *others)], axis=0)
    size = {k: abs(float(mean_bend[k])) for k in axes}
    chosen = max(axes, key=lambda k: size[k])
    if size[chosen] < _MIN_BEND:
        direction = np.eye(dimensions)[default]
        chord = shape[-1] - shape[0]
        down = float(np.sign(chord[default]))
        hangs = abs(chord[default]) > _HANGING * float(np.linalg.norm(chord))
        # Gravity turns a cable towards down: one that turns away from its direction is level.
        if hangs and (size[chosen] < _SLIGHT_BEND or mean_bend[default] * down >= 0.0):
            direction[default] = -down
            return direction, Sure.GUESSED, "the cable, straight at rest, hangs along it"
        if size[chosen] < _SLIGHT_BEND:
            return direction, Sure.GUESSED, "the usual one, for the cable is straight at rest"
    if chosen != default and size[chosen] < _RATIO * size[default]:
        chosen = default
    direction = np.zeros(dimensions)
    direction[chosen] = -np.sign(mean_bend[chosen])
    why = "at rest the cable bends the other way, as gravity does it"
    if size[chosen] < _MIN_BEND:
        return direction, Sure.GUESSED, f"{why}, if only by {size[chosen]:.2g} rad"
    return direction, Sure.SHOWN if chosen == default else Sure.GUESSED, why


def _right(
    places: FloatArray, shape: FloatArray, normal: FloatArray | None, up: FloatArray
) -> tuple[FloatArray, str]:
    """Horizontal direction in the plane from cable to gripper, and a remark if it is oblique."""
    if normal is None:
        level = np.array([up[1], -up[0]])
        remark = ""
    else:
        level = np.cross(up, normal - (normal @ up) * up)
        level = level / np.linalg.norm(level)
        nearest = int(np.argmax(np.abs(level)))
        angle = float(np.arccos(min(1.0, abs(float(level[nearest])))))
        if angle < ALIGNED:
            level = np.zeros(3)
            level[nearest] = 1.0
        remark = "" if angle < ALIGNED else f", {np.degrees(angle):.3g}° from the file's axis"
    towards_cable = float((shape[1:].mean(axis=0) - shape[0]) @ level)
    if towards_cable == 0.0:
        towards_cable = float(np.nanmean(places[:, 1:] - places[:, :1], axis=(0, 1)) @ level)
    return (-level if towards_cable > 0.0 else level) + 0.0, remark


def _words(direction: FloatArray) -> str:
    """A direction in words if it is along an axis of the file, else as numbers."""
    nearest = int(np.argmax(np.abs(direction)))
    if abs(direction[nearest]) <= 1.0 - 1e-9:
        return "[" + ", ".join(f"{v:.4g}" for v in direction) + "] of the file"
    backwards = direction[nearest] < 0
    if len(direction) == 3:
        return f"{'−' if backwards else '+'}{_LETTERS[nearest]} of the file"
    return f"the {('first', 'second')[nearest]} coordinate{', reversed' if backwards else ''}"


#: Maximum mean angle that is not shifted by full turns, rad.  It admits ranges of ±180° and of 0 to
#: 360°, and is far from all usual directions of clamps.
_MAX_MEAN = 1.25 * np.pi
#: A full turn, with a margin for rounding.
_FULL_TURN = 2.001 * np.pi


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
    lost     codes that all coordinates have where the point is not seen
    of_hand  the point is the gripper's, which may really be at such a value
    raises   InputError: there is no such column
    """
    raw = np.full((len(capture.values), len(columns)), unseen)
    for k, name in enumerate(columns):
        if name is not None:
            raw[:, k] = capture.column(name)
    measured = [k for k, name in enumerate(columns) if name is not None]
    raw[lost_rows(raw[:, measured], lost, of_hand)] = np.nan
    return np.column_stack([_along(raw, axis) for axis in _basis(axes)]) * metres_per_unit


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
    right, up = _basis(axes)
    names = [name for name in columns if name is not None]
    raw = capture.at(names)
    across: FloatArray = raw @ np.cross(right, up) * metres_per_unit
    across[lost_rows(raw, lost, of_hand=False)] = np.nan
    return across


def clamp_angle_rad(capture: Capture, angle: AngleSection, axes: AxesSection) -> FloatArray | None:
    """(rows,) clamp angle; None if it follows from a line between points or from an arm.

    0 = level, positive = pointing down; the cable leaves along (−cos, −sin).
    raises  InputError: there is no such column
    """
    if angle.constant_rad is not None:
        return np.full(len(capture.values), angle.constant_rad + angle.offset_rad)
    if angle.column is not None and angle.radians_per_unit is not None:
        angles: FloatArray = capture.column(angle.column) * angle.radians_per_unit
        return continuous(angles, angle.offset_rad)
    if (quaternion := orientation(capture, angle)) is not None and angle.body_axis is not None:
        leaving = body_axis(quaternion, angle.body_axis)
        right, up = (np.append(v, 0.0)[:3] for v in _basis(axes))
        return continuous(_angle(leaving @ right, leaving @ up), angle.offset_rad)
    return None


def orientation(capture: Capture, angle: AngleSection) -> FloatArray | None:
    """(rows, 4) quaternions x, y, z, w of a body; None if none of its columns are named."""
    if angle.rotation is None or angle.order is None or angle.radians_per_unit is None:
        return None if angle.quaternion is None else capture.at(angle.quaternion)
    values = capture.at(angle.rotation) * angle.radians_per_unit
    known = np.isfinite(values).all(axis=1)
    quaternion = np.full((len(values), 4), np.nan)
    if not known.any():
        return quaternion
    if angle.order == "vector":
        quaternion[known] = Rotation.from_rotvec(values[known]).as_quat()
    else:
        in_order = values[known][:, ["XYZ".index(axis) for axis in angle.order]]
        quaternion[known] = Rotation.from_euler(angle.order, in_order).as_quat()
    return quaternion


def angle_towards(from_m: FloatArray, to_m: FloatArray, offset_rad: float = 0.0) -> FloatArray:
    """Clamp angle of a gripper whose cable leaves from one point (rows, 2) towards another."""
    direction = to_m - from_m
    return continuous(_angle(direction[:, 0], direction[:, 1]), offset_rad)


def continuous(angle_rad: FloatArray, offset_rad: float = 0.0) -> FloatArray:
    """(rows,) angles plus an offset, unwrapped, and shifted by full turns to the principal range.

    Angles beyond ±2π must be in another unit; they are not unwrapped.
    """
    finite = np.isfinite(angle_rad)
    known = angle_rad[finite]
    result = angle_rad + offset_rad
    if not len(known) or np.abs(known).max() > _FULL_TURN:
        return result
    known = np.unwrap(known) + offset_rad
    middle = 0.5 * (known.min() + known.max())
    if abs(middle) > _MAX_MEAN:
        known = known - 2.0 * np.pi * np.round(middle / (2.0 * np.pi))
    result[finite] = known
    return result


def body_axis(quaternion: FloatArray, name: str) -> FloatArray:
    """(rows, 3) direction of a body's axis, such as `-x`; quaternions (rows, 4) x, y, z, w."""
    length = np.linalg.norm(quaternion, axis=1)
    valid = np.isfinite(length) & (length > 0.5)
    directions = np.full((len(quaternion), 3), np.nan)
    axis = np.zeros(3)
    axis["xyz".index(name[1])] = -1.0 if name[0] == "-" else 1.0
    if valid.any():
        directions[valid] = Rotation.from_quat(quaternion[valid]).apply(axis)
    return directions


def angle_of(direction: FloatArray) -> float:
    """Clamp angle of one direction (2,) in which a cable leaves, rad."""
    return float(np.arctan2(-direction[1], -direction[0]))


def _angle(x: FloatArray, y: FloatArray) -> FloatArray:
    """Clamp angle of a direction in which a cable leaves, between −π and π."""
    return np.asarray(np.arctan2(-y, -x), dtype=np.float64)


def _basis(axes: AxesSection) -> tuple[FloatArray, FloatArray]:
    """Unit vectors right and up; right is made orthogonal to up."""
    up = np.array(axes.up) / np.linalg.norm(axes.up)
    right = np.array(axes.right) - (np.array(axes.right) @ up) * up
    return right / np.linalg.norm(right), up


def _along(raw: FloatArray, axis: FloatArray) -> FloatArray:
    """Component along an axis; columns orthogonal to it may be missing."""
    used = np.abs(axis) > 0.0
    return np.asarray(raw[:, used] @ axis[used], dtype=np.float64)
