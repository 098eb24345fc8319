"""The clamp angle from a file: its column, unit and sign, or the cable's shape."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, CapturedColumn, ImportFindings, Sure
from cell.study.imports.column_names import Meaning, meaning
from cell.study.imports.contents import HAND, Contents, Point
from cell.study.imports.gripper_section import (
    BODY_AXES,
    ORDERS,
    AngleSection,
    AxesSection,
    GripperSection,
)
from cell.study.imports.places import body_axis, clamp_angle_rad, continuous, orientation
from cell.study.imports.units import RADIANS
from cell.study.series import noise_m, wrapped

#: Largest angle of a clamp in a study, rad.
MOST_RAD = 2.0 * np.pi
#: Rotation above which the cable's root determines the sign of an angle, rad.
_MIN_ROTATION = 0.05
#: Penalties of less usual interpretations of a column, rad: a negative sign, a quarter turn, a unit
#: that is not stated.
_SIGN_COST, _QUARTER_COST, _UNIT_COST = 0.02, 0.3, 0.05
#: Largest difference at rest between the root and a correct angle, rad; else an offset is needed.
_TOLERANCE = 0.35
#: Accuracy of the root at rest by a curve, rad.
_CURVE_STD = 0.0125
#: Number of medians of a trial by which two rotations are compared, and the difference of their
#: ratio from 1 that the cable's bending at its root may cause.
_BLOCKS, _RATIO_TOL = 50, 0.05
#: Out-of-plane rotations of a body in two interpretations are alike up to this ratio, or so small,
#: rad.
_ALIKE, _SMALL_TILT = 1.2, 1e-3
#: An unnamed angle is the clamp's if it is within this of the root at rest, rad.
_SAME_AT_REST = 0.1
#: As _TOLERANCE, for a root estimated by the line to a single marker, from which a cable droops.
_LINE_TOLERANCE = 1.0


@dataclass(frozen=True)
class Root:
    """Estimate of the clamp angle by the direction of the cable at its root.

    angle_rad  (rows,) of the markers' file, approximate during motion
    rest_rad   at rest
    is_line    estimated by the line to the only marker, from which a drooping cable departs
    error_rad  estimated error of `rest_rad`, for its few points
    others     of the other trials: the file with the gripper, and `rest_rad`
    """

    angle_rad: FloatArray
    rest_rad: float
    is_line: bool = False
    error_rad: float = 0.0
    others: tuple[tuple[Capture, float], ...] = ()

    @property
    def agrees_rad(self) -> float:
        """Largest difference at rest between the root and a correct angle."""
        return _LINE_TOLERANCE if self.is_line else _TOLERANCE

    @property
    def std_rad(self) -> float:
        """Accuracy at rest."""
        return _LINE_TOLERANCE if self.is_line else max(_CURVE_STD, self.error_rad)

    def offset_rad(self, shown_rad: float) -> float:
        """Angle from a direction of the gripper to the cable at rest; 0 or π if that may be."""
        offset = wrapped(self.rest_rad - shown_rad)
        for exact in (0.0, float(np.pi)):
            if abs(wrapped(offset - exact)) < self.std_rad:
                return exact
        return float(round(offset, 4))


@dataclass(frozen=True)
class _Reading:
    """One interpretation of a column of angles.

    is_measured  the cable's rotation determines the sign, within a trial or between two
    quarters     number of quarter turns added
    rest_rad     angle of the column at rest, with its own sign
    off_rad      difference from the cable's root at rest, mean over the trials
    """

    unit: str
    sign: float
    is_measured: bool
    quarters: int
    rest_rad: float
    off_rad: float

    @property
    def cost(self) -> float:
        """Difference from the root plus penalties, rad; the least is chosen."""
        unusual = _SIGN_COST * (self.sign < 0.0) + _QUARTER_COST * (self.quarters != 0)
        return self.off_rad + unusual + _UNIT_COST * (self.unit == "deg")


def clamp_angle(
    capture: Capture,
    inside: Contents,
    axes: AxesSection,
    root: Root,
    findings: ImportFindings,
    hand: str = "",
    second: tuple[Point, float] | None = None,
) -> AngleSection:
    """The mapping's section of the clamp angle.

    capture   file of the gripper
    findings  extended by those about the angle
    hand      name of the gripping point, which identifies its columns; empty = it has none
    second    a second point of the gripper, and the angle of the line to it at rest; None = none
    """
    four = next((q for group, q in inside.quaternions if group == hand), None)
    if four is None and len(inside.quaternions) == 1:
        four = inside.quaternions[0][1]
    if four is not None and _is_filler(capture.at(list(four)), hand):
        four = None
    if four is not None and len(axes.up) == len("xyz"):  # one angle is no 3D orientation
        return _section_of_four(capture, four, axes, root, findings)
    angles = tuple(f for f in inside.angles if not _is_heading(capture, inside, *f))
    inside = replace(inside, angles=angles)
    if section := _section_of_three(capture, inside, axes, root, findings, hand):
        return section
    if (column := _column(inside, axes, hand)) is not None:
        return _section_of_column(capture, *column, root, findings)
    if (column := _column_like_root(capture, inside, root)) is not None:
        section = _section_of_column(capture, *column, root, findings)
        sentence = f"{column[0]!r} is the clamp angle, for it agrees with the cable's root"
        findings.guessed("hand.angle", sentence)
        return section
    if four is not None:
        return _section_of_four(capture, four, axes, root, findings)
    if second is not None:
        point, shown_rad = second
        offset = root.offset_rad(shown_rad)
        sentence = f"the clamp angle is that of the line between {hand!r} and {point.name!r}"
        findings.guessed("hand.angle", sentence + _offset_clause(offset))
        return AngleSection(towards=list(point.columns), offset_rad=round(offset, 10))
    angle = round(root.rest_rad, 4) + 0.0
    sentence = "no angle of the gripper is in the file: it is taken as constant, "
    sentence += f"{np.degrees(angle):.2f}°, as the markers show at rest"
    if root.is_line:
        sentence += "; that is the line to the only marker, from which a cable droops: measure it"
    sentence += "; a measured angle is stated by --clamp-angle"
    findings.guessed("hand.angle", sentence)
    return AngleSection(constant_rad=angle)


def stated_angle(
    path: Path, hand: GripperSection, stated_rad: float | None, root: Root, findings: ImportFindings
) -> GripperSection:
    """The gripper with the constant clamp angle that the user states; None = nothing is stated.

    root      of the cable at rest
    findings  those about the angle are replaced
    raises    InputError: a column of the gripper has the angle, or one with which the cable turns;
              or the cable contradicts the statement
    """
    if stated_rad is None:
        return hand
    option = f"--clamp-angle states {np.degrees(stated_rad):.1f}°"
    about = [f for f in findings if f.entry.startswith("hand.angle")]
    guessed = all(f.sure is Sure.GUESSED for f in about) and not _is_of_gripper(hand)
    if hand.angle.constant_rad is None and hand.angle != AngleSection() and not guessed:
        found = " ".join(f.sentence for f in about if f.entry == "hand.angle")
        raise InputError.at(path, f"{option}, but {found}; leave the option out")
    if abs(wrapped(root.rest_rad - stated_rad)) > root.agrees_rad:
        shown, limit = np.degrees([root.rest_rad, root.agrees_rad])
        message = f"{option}, but at rest the cable leaves the gripper at {shown:.1f}°, limit "
        message += f"{limit:.0f}° apart; 0 = level, positive = tip down: correct the option, or "
        message += "leave it out and check the `axes` of the proposal"
        raise InputError.at(path, message)
    findings[:] = [f for f in findings if f not in about]
    angle = f"{np.degrees(stated_rad):.2f}°"
    findings.stated("hand.angle", f"the clamp angle is {angle}, constant, as --clamp-angle says")
    return hand.model_copy(update={"angle": AngleSection(constant_rad=stated_rad)})


def _is_of_gripper(hand: GripperSection) -> bool:
    """Whether the angle is in the gripper's own file, or in columns named after it."""
    angle = hand.angle
    turning = (angle.quaternion, angle.rotation, angle.towards)
    names = [angle.column or "", *(name for columns in turning for name in columns or ())]
    words = {word for name in names for word in meaning(CapturedColumn(name)).group.split()}
    return hand.time is not None or bool(angle.follows or HAND & words)


def _is_filler(quaternion: FloatArray, hand: str) -> bool:
    """Whether a point not named after a gripper has no rotation in any row: programs fill it in."""
    known = quaternion[np.isfinite(quaternion).all(axis=1)]
    return not HAND.intersection(hand.split()) and bool(np.all(known == [0.0, 0.0, 0.0, 1.0]))


def _offset_clause(offset_rad: float) -> str:
    """End of a sentence about an offset; empty without one."""
    degrees = np.degrees(offset_rad)
    return f", turned by {degrees:.1f}° as the cable shows at rest" if offset_rad else ""


def _is_heading(capture: Capture, inside: Contents, name: str, of: Meaning) -> bool:
    """Whether the angle of a point not named after a gripper is the direction of its motion: it is
    undefined before the first step, or turns farther than any clamp."""
    point = inside.point(of.group)
    if point is None or point.on_gripper:
        return False
    values = capture.column(name)
    known = values[np.isfinite(values)]
    if np.isnan(values[0]) and np.isfinite(capture.at(list(point.columns))[0]).all():
        return True
    most = float(np.abs(known).max(initial=0.0))
    turned = known * RADIANS.get(of.unit, 1.0 if most <= MOST_RAD else RADIANS["deg"])
    return len(known) > 0 and float(np.ptp(continuous(turned))) > MOST_RAD


def _angles_of_gripper(inside: Contents, hand: str) -> list[tuple[str, Meaning]]:
    """Columns of angles of the gripper, else those of no point."""
    own = [(n, m) for n, m in inside.angles if hand and m.group == hand]
    of_hand = [(n, m) for n, m in inside.angles if HAND.intersection(m.group.split())]
    return own or of_hand or [(n, m) for n, m in inside.angles if not m.group]


def _column(inside: Contents, axes: AxesSection, hand: str) -> tuple[str, Meaning] | None:
    """The column of the clamp angle: the gripper's, about the normal of the plane."""
    chosen = _angles_of_gripper(inside, hand)
    if len(axes.up) == 3:
        letter = "xyz"[int(np.argmax(np.abs(np.cross(axes.right, axes.up))))]
        chosen = [(n, m) for n, m in chosen if m.axis == letter] or chosen
    return chosen[0] if chosen else None


def _column_like_root(capture: Capture, inside: Contents, root: Root) -> tuple[str, Meaning] | None:
    """A column of angles of no marker that agrees with the cable's root; None = there is none."""
    points = [f"{point.name} " for point in inside.points if not point.on_gripper]
    for name, of in inside.angles:
        if of.axis or any(f"{of.group} ".startswith(point) for point in points):
            continue
        readings = _readings(capture.column(name), name, of.unit, root)
        best = min(readings, key=lambda r: r.cost, default=None)
        if best and best.quarters == 0 and (best.is_measured or best.off_rad < _SAME_AT_REST):
            return name, of
    return None


def _section_of_column(
    capture: Capture, name: str, of: Meaning, root: Root, findings: ImportFindings
) -> AngleSection:
    """Section of a column of angles; unit, sign and zero are estimated from the cable's root.

    If the root turns otherwise, an angle about an axis is none of the clamp's; one without an axis
    is taken as it is called, to be checked.
    """
    values, unit = capture.column(name), of.unit
    readings = _readings(values, name, unit, root)
    if not readings and of.axis:
        return _no_angle(name, findings)
    if not readings:
        readings = _readings(values, name, unit, replace(root, angle_rad=np.empty(0), others=()))
        sentence = f"the cable's root does not turn by as much as {name!r}: check both"
        findings.guessed("hand.angle", sentence)
    best = min(readings, key=lambda reading: reading.cost)
    word, sign, offset = best.unit, best.sign, best.quarters * np.pi / 2.0
    needs_offset = best.off_rad > root.agrees_rad
    all_values = [values, *(c.column(name) for c, _ in root.others if name in c.names)]
    is_nonzero = max(float(np.nanmax(np.abs(v))) for v in all_values) * RADIANS[word] > 1e-3
    which = "positive = down" if sign > 0 else "positive = up, turned round"
    why = "the cable turns with it" if best.is_measured else "the cable's root at rest agrees best"
    if not is_nonzero:
        why = f"it is 0 throughout {capture.path.name}"
    if best.quarters and not needs_offset:
        which += f", turned by {90 * best.quarters}°"
    report = findings.shown if best.is_measured or not is_nonzero else findings.guessed
    stated = ", as the file says" if unit in RADIANS else ""
    report("hand.angle", f"the clamp angle is column {name!r} in {word}{stated}; {which}: {why}")
    if needs_offset:
        offset = float(round(wrapped(root.rest_rad - sign * best.rest_rad), 4))
        findings.guessed(
            "hand.angle.offset_rad",
            f"{name!r} is {np.degrees(best.off_rad):.0f}° from what the cable shows at rest: an "
            "offset is added",
        )
    factor = round(sign * RADIANS[word], 12)
    return AngleSection(column=name, radians_per_unit=factor, offset_rad=round(offset, 10) + 0.0)


def _readings(values: FloatArray, name: str, unit: str, root: Root) -> list[_Reading]:
    """All interpretations of a column of angles over all trials, the usual ones first."""
    readings = []
    others = [(c.column(name), shown) for c, shown in root.others if name in c.names]
    all_values = [values, *(v for v, _ in others)]
    roots_rad = np.array([root.rest_rad, *(shown for _, shown in others)])
    largest = max(float(np.nanmax(np.abs(v))) for v in all_values)
    for word in [unit] if unit in RADIANS else ["rad", "deg"]:
        if word == "rad" and unit not in RADIANS and largest > 2.0 * np.pi:
            continue
        turned = [continuous(v * RADIANS[word]) for v in all_values]
        rests_rad = np.array([np.nanmedian(_first(v)) for v in turned])
        signs = _signs(turned[0], root.angle_rad, root)
        signs = _signs(rests_rad, np.unwrap(roots_rad), root) if len(signs) == 2 else signs
        for sign in signs:
            for quarters in (0, -1, 1, 2):
                apart_rad = sign * rests_rad + quarters * np.pi / 2.0 - roots_rad
                off_rad = float(np.mean([abs(wrapped(a)) for a in apart_rad]))
                sure, rest_rad = len(signs) == 1, float(rests_rad[0])
                readings.append(_Reading(word, sign, sure, quarters, rest_rad, off_rad))
    return readings


def _signs(values: FloatArray | None, shown_rad: FloatArray, root: Root) -> tuple[float, ...]:
    """Signs with which an angle turns as the cable's root; both if that is undetermined.

    The ratio of their turns is ±1 within its uncertainty: an angle that is merely correlated with
    the clamp's has another one.
    """
    if values is None or len(values) != len(shown_rad):
        return 1.0, -1.0
    rows = np.flatnonzero(np.isfinite(values) & np.isfinite(shown_rad))
    if not len(rows):
        return 1.0, -1.0
    blocks = np.array_split(rows, min(_BLOCKS, len(rows)))
    x, y = (np.array([np.median(v[block]) for block in blocks]) for v in (values, shown_rad))
    if min(np.ptp(x), np.ptp(y)) < _MIN_ROTATION:
        return 1.0, -1.0
    x, y = x - x.mean(), y - y.mean()
    ratio = float(x @ y / (x @ x))
    variance = float(np.sum((y - ratio * x) ** 2) + root.std_rad**2) / max(1, len(x) - 2)
    limit = max(_RATIO_TOL, 3.0 * float(np.sqrt(variance / (x @ x))))
    return tuple(sign for sign in (1.0, -1.0) if abs(ratio - sign) <= limit)


def _no_angle(name: str, findings: ImportFindings) -> AngleSection:
    """The section that the user must fill in, for the cable's root turns otherwise."""
    sentence = f"{name!r} does not turn by as much as the cable's root: it is not the clamp angle; "
    findings.missing("hand.angle", f"{sentence}give hand.angle, or --clamp-angle")
    return AngleSection()


#: Names of a rotation vector, and of turns about fixed axes x, y, z.
_VECTOR = re.compile(r"(?<![a-z])r[_ ]?[xyz](?![a-z])")
_ROLL = re.compile("roll|pitch|yaw")


def _section_of_three(
    capture: Capture,
    inside: Contents,
    axes: AxesSection,
    root: Root,
    findings: ImportFindings,
    hand: str,
) -> AngleSection | None:
    """Section of three angles of the gripper about x, y and z; None = there are not three, or in no
    order the gripper turns as the cable's root.

    The order is the stated one, else the usual one of such names, unless only in another one the
    gripper turns in the plane.
    source  Vicon Tracker, Universal Robots: RX, RY, RZ are a rotation vector; ROS REP 103: roll,
            pitch, yaw are about fixed axes
    """
    found = _angles_of_gripper(inside, hand)
    chosen = {m.axis: (n, m.unit) for n, m in reversed(found) if m.group == found[0][1].group}
    if len(axes.up) < 3 or set(chosen) != set("xyz"):
        return None
    names, unit = [chosen[axis][0] for axis in "xyz"], chosen["x"][1]
    usual = "vector" if _VECTOR.search(names[0].lower()) else "XYZ"
    usual = "ZYX" if _ROLL.search(names[0].lower()) else usual
    orders = [capture.order] if capture.order else sorted(ORDERS, key=lambda order: order != usual)
    values = capture.at(names)
    largest = np.abs(np.nan_to_num(values)).max()
    in_rad = largest <= 2.0 * np.pi and noise_m(values) < _CURVE_STD
    for word in [unit] if unit in RADIANS else ["rad", "deg"] if in_rad else ["deg"]:
        factor = round(RADIANS[word], 12)
        forms = [AngleSection.model_validate({"rotation": names, "order": order,
                 "radians_per_unit": factor}) for order in orders]  # fmt: skip
        if section := _section_of_body(capture, forms, axes, root, findings):
            return section
    return None


def _section_of_four(
    capture: Capture, four: Sequence[str], axes: AxesSection, root: Root, findings: ImportFindings
) -> AngleSection:
    """Section of a quaternion whose w is last or first; to fill in if neither turns as the root."""
    forms = [AngleSection(quaternion=[*order]) for order in (four, (*four[1:], four[0]))]
    section = _section_of_body(capture, forms, axes, root, findings)
    if section is not None and section.quaternion != [*four]:
        sentence = f"{four[0]!r} is w, x, y and z follow: so it turns as the cable's root"
        findings.guessed("hand.angle", sentence)
    return section or _no_angle(four[0], findings)


def _section_of_body(
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
    signs = [_signs(clamp_angle_rad(capture, s, axes), root.angle_rad, root) for s in sections]
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
    sentence += f"{section.body_axis}{_offset_clause(section.offset_rad)}"
    findings.guessed("hand.angle", sentence)
    if not same:
        sentence = "it turns opposite to the cable's root: is it in other axes, or the inverse?"
        findings.guessed("hand.angle", sentence)
    return section


def _tilt_rad(capture: Capture, section: AngleSection, axes: AxesSection) -> float:
    """Root mean square of a body's rotation since its first rows, other than in the plane."""
    quaternion = orientation(capture, section)
    assert quaternion is not None
    known = quaternion[np.linalg.norm(np.nan_to_num(quaternion), axis=1) > 0.5]
    if not len(known):
        return 0.0
    initial = Rotation.from_quat(_first(known)).mean()
    turn = (Rotation.from_quat(known) * initial.inv()).as_rotvec()
    return float(np.sqrt(np.mean(np.sum((turn @ _plane(axes).T) ** 2, axis=1))))


def _plane(axes: AxesSection) -> FloatArray:
    """(2, 3) right and up in space."""
    return np.array([np.append(v, 0.0)[:3] for v in (axes.right, axes.up)])


def _first(values: FloatArray) -> FloatArray:
    """The first rows, which show the initial value."""
    return values[: max(1, len(values) // 20)]


def _along_axis(
    capture: Capture, form: AngleSection, axes: AxesSection, root: Root
) -> AngleSection:
    """The form with the body's axis along which the cable leaves at rest, and an offset to it."""
    quaternion = orientation(capture, form)
    assert quaternion is not None
    leaving = -np.array([np.cos(root.rest_rad), np.sin(root.rest_rad)]) @ _plane(axes)
    rows = _first(quaternion[np.isfinite(quaternion).all(axis=1)])
    along = {n: float(np.nansum(body_axis(rows, n) @ leaving)) for n in BODY_AXES}
    section = form.model_copy(update={"body_axis": max(BODY_AXES, key=lambda n: along[n])})
    angle = clamp_angle_rad(capture, section, axes)
    assert angle is not None
    known = angle[np.isfinite(angle)]
    offset = root.offset_rad(float(np.median(_first(known)))) if len(known) else 0.0
    return section.model_copy(update={"offset_rad": offset})
