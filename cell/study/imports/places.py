"""The study's plane, found by the motion; columns of a file as places, m, and angles in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, Finding, ImportFindings, Sure
from cell.study.imports.gripper_section import AngleSection, AxesSection
from cell.study.imports.shape import bend, lost_rows

#: An axis of the file is in the plane if this share of it is.
_IN_PLANE = 0.9
#: A bend of the cable decides what is up if it is this large (1 = by a radian), and speaks so many
#: times more for one axis than for the usual one.
_BEND, _TIMES = 0.1, 1.5
#: A cable that is straight at rest hangs if it is along the vertical by this cosine.
_HANGS = 0.9
#: A plane nearer to the file's axes than this is along them, rad: half a degree moves a place
#: within the plane by 4 parts in 100,000.
_ALONG = 0.0087
_LETTERS = "XYZ"


@dataclass(frozen=True)
class _Up:
    direction: FloatArray
    sure: Sure
    why: str


def find_axes(
    places: FloatArray, shape: FloatArray, others: Sequence[FloatArray] = ()
) -> tuple[AxesSection, ImportFindings]:
    """Directions of x (right) and y (up) of the study, such that the cable leaves towards −x.

    places  (rows, points, 2 or 3) in order along the cable, the gripper first
    shape   (points, d) of the cable at rest, or its mean
    others  the same of the other trials
    """
    dimensions = places.shape[2]
    normal, flat = _normal(places)
    up = _up(shape, others, normal)
    right, along = _right(places, shape, normal, up.direction)
    findings = ImportFindings()
    if normal is not None:
        findings.seen("axes", f"the motion is in one plane, {flat:.2g} of its size out of it")
    findings.append(Finding("axes.up", f"up is {_words(up.direction)}: {up.why}", up.sure))
    sentence = f"right is {_words(right)}: so the cable leaves the gripper to the left{along}"
    findings.seen("axes.right", sentence)
    section = AxesSection(right=_plain(right, dimensions), up=_plain(up.direction, dimensions))
    return section, findings


def _normal(places: FloatArray) -> tuple[FloatArray | None, float]:
    """Across the plane in which all points are, and what is out of it, as a share; None in 2D."""
    if places.shape[2] == 2:
        return None, 0.0
    seen = places[np.isfinite(places).all(axis=2)]
    centred = seen - np.median(seen, axis=0)
    _, sizes, directions = np.linalg.svd(centred, full_matrices=False)
    return directions[2], float(sizes[2] / sizes[0])


def _up(shape: FloatArray, others: Sequence[FloatArray], normal: FloatArray | None) -> _Up:
    """Which axis of the file is up: the one against which the cable bends from its clamp on."""
    dimensions = shape.shape[1]
    axes = [k for k in range(dimensions) if normal is None or _in_plane(normal, k)]
    if not axes and normal is not None:  # a plane that is askew to all of them
        axes = [int(np.argmin(np.abs(normal)))]
    usual = 1 if dimensions == 2 or 2 not in axes else 2
    if usual not in axes:
        usual = axes[0]
    bent = np.mean([bend(s) for s in (shape, *others)], axis=0)
    size = {k: abs(float(bent[k])) for k in axes}
    chosen = max(axes, key=lambda k: size[k])
    if size[chosen] < _BEND:
        direction = np.zeros(dimensions)
        direction[usual] = 1.0
        along = shape[-1] - shape[0]
        if abs(along[usual]) > _HANGS * float(np.linalg.norm(along)):
            direction[usual] = -np.sign(along[usual])
            return _Up(direction, Sure.GUESSED, "the cable, straight at rest, hangs along it")
        return _Up(direction, Sure.GUESSED, "the usual one, for the cable is straight at rest")
    if chosen != usual and size[chosen] < _TIMES * size[usual]:
        chosen = usual
    direction = np.zeros(dimensions)
    direction[chosen] = -np.sign(bent[chosen])
    sure = Sure.SEEN if chosen == usual else Sure.GUESSED
    return _Up(direction, sure, "at rest the cable bends the other way, as gravity does it")


def _in_plane(normal: FloatArray, axis: int) -> bool:
    return bool(np.sqrt(1.0 - min(1.0, float(normal[axis] ** 2))) > _IN_PLANE)


def _right(
    places: FloatArray, shape: FloatArray, normal: FloatArray | None, up: FloatArray
) -> tuple[FloatArray, str]:
    """The level direction in the plane, from the cable to the gripper."""
    if normal is None:
        level = np.array([up[1], -up[0]])
        told = ""
    else:
        level = np.cross(up, normal - (normal @ up) * up)
        level = level / np.linalg.norm(level)
        nearest = int(np.argmax(np.abs(level)))
        turned = float(np.arccos(min(1.0, abs(float(level[nearest])))))
        if turned < _ALONG:
            level = np.zeros(3)
            level[nearest] = 1.0
        told = "" if turned < _ALONG else f", {np.degrees(turned):.3g}° from the file's axis"
    leaves = float((shape[1:].mean(axis=0) - shape[0]) @ level)
    if leaves == 0.0:
        leaves = float(np.nanmean(places[:, 1:] - places[:, :1], axis=(0, 1)) @ level)
    return (-level if leaves > 0.0 else level) + 0.0, told


def _words(direction: FloatArray) -> str:
    """A direction in words where it is along an axis of the file, else as numbers."""
    nearest = int(np.argmax(np.abs(direction)))
    if abs(direction[nearest]) <= 1.0 - 1e-9:
        return "[" + ", ".join(f"{v:.4g}" for v in direction) + "] of the file"
    backwards = direction[nearest] < 0
    if len(direction) == 3:
        return f"{'−' if backwards else '+'}{_LETTERS[nearest]} of the file"
    return f"the {('first', 'second')[nearest]} coordinate{', reversed' if backwards else ''}"


def _plain(direction: FloatArray, dimensions: int) -> list[float]:
    return [round(float(v), 7) + 0.0 for v in direction[:dimensions]]


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
