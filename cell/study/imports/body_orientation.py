"""The clamp angle from a body's orientation: a quaternion, or three angles of one rotation."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from cell.cable.arrays import FloatArray
from cell.study.imports.cable_root import (
    CURVE_STD,
    MIN_ROTATION,
    Root,
    first_rows,
    signs_by_ends,
    turn_signs,
)
from cell.study.imports.capture import Capture, ImportFindings
from cell.study.imports.column_names import Meaning
from cell.study.imports.contents import HAND, Contents
from cell.study.imports.gripper_section import (
    BODY_AXES,
    ORDERS,
    AngleSection,
    AxesSection,
    RotationOrder,
)
from cell.study.imports.places import body_axis, clamp_angle_rad, orientation
from cell.study.imports.units import RADIANS
from cell.study.series import noise_m

#: Out-of-plane rotations of a body in two interpretations are alike up to this ratio, or so small,
#: rad.
_ALIKE, _SMALL_TILT = 1.2, 1e-3
#: A body turns about one axis if its other rotation is a smaller share than this.
_OTHER_SHARE = 0.2
#: Names of three angles whose program states their convention: a rotation vector, or the order of
#: turns about a body's own axes.
_CONVENTIONS: tuple[tuple[re.Pattern[str], RotationOrder], ...] = (
    (re.compile(r"(?<![a-z])r[_ ]?[xyz](?![a-z])"), "vector"),
    (re.compile("roll|pitch|yaw"), "ZYX"),
    (re.compile("cart[_ ]?pos.*alpha"), "XYZ"),
)


def usual_order(name: str) -> RotationOrder | None:
    """The convention of three angles by the name of the first; None = programs differ.

    source  Vicon Tracker, Universal Robots: RX, RY, RZ are a rotation vector; ROS REP 103: roll,
            pitch, yaw are about fixed axes; Mecademic: alpha, beta, gamma are mobile XYZ angles
    """
    return next((order for form, order in _CONVENTIONS if form.search(name.lower())), None)


def quaternion_of(capture: Capture, inside: Contents, hand: str) -> tuple[str, ...] | None:
    """Columns of the gripper's quaternion; None = it has none."""
    four = next((q for group, q in inside.quaternions if group == hand), None)
    if four is None and len(inside.quaternions) == 1:
        four = inside.quaternions[0][1]
    return None if four is None or _is_filler(capture.at(list(four)), hand) else four


def _is_filler(quaternion: FloatArray, hand: str) -> bool:
    """Whether a point not named after a gripper has no rotation in any row: programs fill it in."""
    known = quaternion[np.isfinite(quaternion).all(axis=1)]
    return not HAND.intersection(hand.split()) and bool(np.all(known == [0.0, 0.0, 0.0, 1.0]))


def angles_of_gripper(inside: Contents, hand: str) -> list[tuple[str, Meaning]]:
    """Columns of angles of the gripper, else those of no point."""
    own = [(n, m) for n, m in inside.angles if hand and m.group == hand]
    of_hand = [(n, m) for n, m in inside.angles if HAND.intersection(m.group.split())]
    return own or of_hand or [(n, m) for n, m in inside.angles if not m.group]


#: Standard deviations from quarter turns within which an offset may be none: the cable is held
#: askew or bends within its clamp, an effect which the model should have.
_SIGMAS = 3.0
#: A column that states its place in a quaternion: letters of unnamed columns follow a space.
_STATES_AXIS = re.compile(r".*[^ ]([xyzw])")


def forms_of_four(capture: Capture, four: Sequence[str]) -> list[AngleSection]:
    """Interpretations of a quaternion: w is last; or first, if the file does not state it."""
    orders = [four, (*four[1:], four[0])]
    named = (_STATES_AXIS.fullmatch(name.lower()) for name in four)
    if capture.are_computed(four) or [match and match[1] for match in named] == [*"xyzw"]:
        orders = [four]
    return [AngleSection(quaternion=[*order]) for order in orders]


def forms_of_three(capture: Capture, inside: Contents, hand: str) -> Iterator[list[AngleSection]]:
    """Interpretations of three angles of the gripper about x, y and z, the usual one first, for
    each unit that they may have; nothing if there are not three.

    The order is the stated one, else any: the usual one of such names first.
    """
    found = angles_of_gripper(inside, hand)
    chosen = {m.axis: (n, m.unit) for n, m in reversed(found) if m.group == found[0][1].group}
    if set(chosen) != set("xyz"):
        return
    names, unit = [chosen[axis][0] for axis in "xyz"], chosen["x"][1]
    usual = usual_order(names[0]) or "XYZ"
    orders = [capture.order] if capture.order else sorted(ORDERS, key=lambda order: order != usual)
    values = capture.at(names)
    largest = np.abs(np.nan_to_num(values)).max()
    in_rad = largest <= 2.0 * np.pi and noise_m(values) < CURVE_STD
    for word in [unit] if unit in RADIANS else ["rad", "deg"] if in_rad else ["deg"]:
        factor = round(RADIANS[word], 12)
        yield [
            AngleSection.model_validate(
                {"rotation": names, "order": order, "radians_per_unit": factor}
            )
            for order in orders
        ]


@dataclass(frozen=True, eq=False)
class BodyTurn:
    """How a body turns about one axis.

    normal  (3,) unit vector, in the axes of its file
    signed  whether about it the body turns as the clamp does; else it may be the opposite
    """

    normal: FloatArray
    signed: bool

    def across(self, normal: FloatArray) -> float:
        """Sine of the angle to the normal (3,) of a plane; 1 if it turns the other way."""
        cosine = float(self.normal @ normal) * (
            1.0 if self.signed else np.sign(self.normal @ normal)
        )
        return float(np.sqrt(max(0.0, 1.0 - cosine**2))) if cosine > 0.0 else 1.0


def body_turn(capture: Capture, inside: Contents, hand: str, root: Root) -> BodyTurn | None:
    """How the gripper turns in all trials; None = it hardly does, or not about one axis."""
    four = quaternion_of(capture, inside, hand)
    groups = [forms_of_four(capture, four)] if four else forms_of_three(capture, inside, hand)
    for forms in groups:
        turns = [t for form in forms if (t := _turn(capture, form, root)) is not None]
        least = min((tilt for _, tilt in turns), default=0.0)
        for turn, tilt in turns:
            if tilt <= _ALIKE * least + _SMALL_TILT:
                return turn
    return None


def _turn(capture: Capture, form: AngleSection, root: Root) -> tuple[BodyTurn, float] | None:
    """How a body turns by one interpretation, and its rotation about other axes, rad."""
    captures = [end.capture for end in root.ends] or [capture]
    names = form.quaternion or form.rotation or []
    captures = [c for c in captures if set(names) <= set(c.names)] or [capture]
    turned = np.concatenate([_rotations(c, form, captures[0]) for c in captures])
    if not len(turned):
        return None
    _, sizes, directions = np.linalg.svd(turned, full_matrices=False)
    normal: FloatArray = directions[0]
    if np.ptp(turned @ normal) < MIN_ROTATION or sizes[1] > _OTHER_SHARE * sizes[0]:
        return None
    signs = signs_by_ends(lambda c: _rotations(c, form, captures[0]) @ normal, root)
    if not signs:
        return None
    tilt = float(np.sqrt(np.mean(np.sum((turned - np.outer(turned @ normal, normal)) ** 2, 1))))
    return BodyTurn(signs[0] * normal, len(signs) == 1), tilt


def _rotations(capture: Capture, form: AngleSection, first: Capture) -> FloatArray:
    """(rows, 3) rotation vectors of a body since the first rows of the first trial."""
    quaternions = [orientation(c, form) for c in (capture, first)]
    lengths = [np.linalg.norm(np.nan_to_num(q), axis=1) for q in quaternions if q is not None]
    known, initial = (
        q[n > 0.5] for q, n in zip(quaternions, lengths, strict=True) if q is not None
    )
    if not len(known) or not len(initial):
        return np.empty((0, 3))
    turned = Rotation.from_quat(known) * Rotation.from_quat(first_rows(initial)).mean().inv()
    return np.asarray(turned.as_rotvec())


def section_of_body(
    capture: Capture,
    forms: Sequence[AngleSection],
    axes: AxesSection,
    root: Root,
    findings: ImportFindings,
) -> AngleSection | None:
    """Section of the body's axis nearest to the direction in which the cable leaves the body.

    forms    interpretations of its columns, the usual one first; chosen is the first in which it
             turns in the plane, as far as the cable's root does
    returns  None = in none it turns as far
    """
    sections = [_along_axis(capture, form, axes, root) for form in forms]
    signs = [turn_signs(partial(_angle_in, s, axes), capture, root) for s in sections]
    same = [s for s, found in zip(sections, signs, strict=True) if 1.0 in found]
    opposite = [s for s, found in zip(sections, signs, strict=True) if found and s.quaternion]
    sections = same or opposite
    if not sections:
        return None
    tilts = [_tilt_rad(capture, s, axes) for s in sections]
    usual = tilts[0] <= _ALIKE * min(tilts) + _SMALL_TILT
    section = sections[0 if usual else int(np.argmin(tilts))]
    names = section.quaternion or section.rotation or []
    how = f", in the order {section.order}" if section.order else ""
    how = ", a rotation vector" if section.order == "vector" else how
    sentence = f"the gripper turns as {names[0]!r} … say{how}; the cable leaves along its axis "
    sentence += f"{section.body_axis}{offset_clause(section.offset_rad, root)}"
    findings.guessed("hand.angle", sentence)
    if not same:
        sentence = "it turns opposite to the cable's root: is it in other axes, or the inverse?"
        findings.guessed("hand.angle", sentence)
    return section


def _angle_in(section: AngleSection, axes: AxesSection, capture: Capture) -> FloatArray | None:
    """(rows,) clamp angle in a file; None = it has other columns."""
    names = section.quaternion or section.rotation or []
    return clamp_angle_rad(capture, section, axes) if set(names) <= set(capture.names) else None


def offset_clause(offset_rad: float, root: Root) -> str:
    """End of a sentence about an offset, with the uncertainty of the cable's root."""
    if offset_rad:
        std = f"± {np.degrees(root.clamp_std_rad):.1f}°"
        turned = f", turned by {np.degrees(offset_rad):.1f}° {std} as the cable shows at rest"
        exact = np.round(offset_rad / (np.pi / 2.0)) * np.pi / 2.0
        if not 0.0 < abs(offset_rad - exact) < _SIGMAS * root.clamp_std_rad:
            return turned
        return f"{turned}; give offset_rad: {exact:.6g} if the jaws are parallel to its axes"
    return f", within {np.degrees(root.std_rad):.1f}° of the cable at rest"


def _tilt_rad(capture: Capture, section: AngleSection, axes: AxesSection) -> float:
    """Root mean square of a body's rotation since its first rows, other than in the plane."""
    turn = _rotations(capture, section, capture)
    return float(np.sqrt(np.mean(np.sum((turn @ _plane(axes).T) ** 2, axis=1)))) if len(turn) else 0


def _plane(axes: AxesSection) -> FloatArray:
    """(2, 3) right and up in space."""
    return np.array([np.append(v, 0.0)[:3] for v in (axes.right, axes.up)])


def _along_axis(
    capture: Capture, form: AngleSection, axes: AxesSection, root: Root
) -> AngleSection:
    """The form with the body's axis along which the cable leaves at rest, and an offset to it."""
    quaternion = orientation(capture, form)
    assert quaternion is not None
    leaving = -np.array([np.cos(root.rest_rad), np.sin(root.rest_rad)]) @ _plane(axes)
    rows = first_rows(quaternion[np.isfinite(quaternion).all(axis=1)])
    along = {n: float(np.nansum(body_axis(rows, n) @ leaving)) for n in BODY_AXES}
    section = form.model_copy(update={"body_axis": max(BODY_AXES, key=lambda n: along[n])})
    angle = clamp_angle_rad(capture, section, axes)
    assert angle is not None
    known = angle[np.isfinite(angle)]
    offset = root.offset_rad(float(np.median(first_rows(known)))) if len(known) else 0.0
    return section.model_copy(update={"offset_rad": offset})
