"""The clamp angle from a file: its column, unit and sign, or the cable's shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError
from cell.study.imports.capture import Capture, CapturedColumn, ImportFindings, Sure
from cell.study.imports.column_names import Meaning, meaning
from cell.study.imports.contents import HAND, Contents, Point
from cell.study.imports.gripper_section import (
    BODY_AXES,
    AngleSection,
    AxesSection,
    GripperSection,
)
from cell.study.imports.places import angle_of, body_axis, clamp_angle_rad, continuous
from cell.study.imports.units import RADIANS
from cell.study.series import wrapped

#: Largest angle of a clamp in a study, rad.
MOST_RAD = 2.0 * np.pi
#: Rotation above which the cable's root determines the sign of an angle, rad.
_MIN_ROTATION = 0.05
#: Penalties of less usual interpretations of a column, rad: a negative sign, a quarter turn, a unit
#: that is not stated.
_SIGN_COST, _QUARTER_COST, _UNIT_COST = 0.02, 0.3, 0.05
#: Largest difference at rest between the root and a correct angle, rad; else an offset is needed.
_TOLERANCE = 0.35
#: Relative difference between the rotations of body and root: above the first the quaternion's
#: order is wrong, below the second it is correct.
_WRONG_ORDER, _RIGHT_ORDER = 0.8, 0.4
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
    others     of the other trials: the file with the gripper, and `rest_rad`
    """

    angle_rad: FloatArray
    rest_rad: float
    is_line: bool = False
    others: tuple[tuple[Capture, float], ...] = ()

    @property
    def agrees_rad(self) -> float:
        """Largest difference at rest between the root and a correct angle."""
        return _LINE_TOLERANCE if self.is_line else _TOLERANCE


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
        return _section_of_body(capture, four, axes, root, findings)
    angles = tuple(f for f in inside.angles if not _is_heading(capture, inside, *f))
    inside = replace(inside, angles=angles)
    if (column := _column(inside, axes, hand)) is not None:
        return _section_of_column(capture, *column, root, findings)
    if (column := _column_like_root(capture, inside, root)) is not None:
        section = _section_of_column(capture, *column, root, findings)
        sentence = f"{column[0]!r} is the clamp angle, for it agrees with the cable's root"
        findings.guessed("hand.angle", sentence)
        return section
    if four is not None:
        return _section_of_body(capture, four, axes, root, findings)
    if second is not None:
        return _section_of_line(*second, root, hand, findings)
    angle = round(root.rest_rad, 4) + 0.0
    sentence = (
        "no angle of the gripper is in the file: it is taken as constant, "
        f"{np.degrees(angle):.2f}°, as the markers show at rest"
    )
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
    names = [angle.column or "", *(angle.quaternion or ()), *(angle.towards or ())]
    words = {word for name in names for word in meaning(CapturedColumn(name)).group.split()}
    return hand.time is not None or bool(angle.follows or HAND & words)


def _is_filler(quaternion: FloatArray, hand: str) -> bool:
    """Whether a point not named after a gripper has no rotation in any row: programs fill it in."""
    known = quaternion[np.isfinite(quaternion).all(axis=1)]
    return not HAND.intersection(hand.split()) and bool(np.all(known == [0.0, 0.0, 0.0, 1.0]))


def _section_of_line(
    second: Point, shown_rad: float, root: Root, hand: str, findings: ImportFindings
) -> AngleSection:
    """The line between two points of the gripper, along the cable or against it."""
    offset = wrapped(root.rest_rad - shown_rad)
    offset = 0.0 if abs(offset) < root.agrees_rad else offset
    if abs(abs(offset) - np.pi) < _TOLERANCE:
        offset = float(np.pi)
    sentence = f"the clamp angle is that of the line between {hand!r} and {second.name!r}"
    findings.guessed("hand.angle", sentence + _offset_clause(offset))
    return AngleSection(towards=list(second.columns), offset_rad=round(offset, 10))


def _offset_clause(offset_rad: float) -> str:
    """End of a sentence about an offset; empty without one."""
    degrees = np.degrees(offset_rad)
    return f", turned by {degrees:.0f}° as the cable shows at rest" if offset_rad else ""


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


def _column(inside: Contents, axes: AxesSection, hand: str) -> tuple[str, str] | None:
    """The column of the clamp angle and its unit: the gripper's, about the normal of the plane."""
    own = [(n, m) for n, m in inside.angles if hand and m.group == hand]
    of_hand = [(n, m) for n, m in inside.angles if HAND.intersection(m.group.split())]
    chosen = own or of_hand or [(n, m) for n, m in inside.angles if not m.group]
    if not chosen:
        return None
    if len(axes.up) == 3 and len(chosen) > 1:
        normal = np.abs(np.cross(axes.right, axes.up))
        letter = "xyz"[int(np.argmax(normal))]
        chosen = [(n, m) for n, m in chosen if m.axis == letter] or chosen
    name, meaning = chosen[0]
    return name, meaning.unit


def _column_like_root(capture: Capture, inside: Contents, root: Root) -> tuple[str, str] | None:
    """A column of angles of no marker that agrees with the cable's root; None = there is none."""
    points = [f"{point.name} " for point in inside.points if not point.on_gripper]
    for name, of in inside.angles:
        if of.axis or any(f"{of.group} ".startswith(point) for point in points):
            continue
        best = min(_readings(capture.column(name), name, of.unit, root), key=lambda r: r.cost)
        if best.quarters == 0 and (best.is_measured or best.off_rad < _SAME_AT_REST):
            return name, of.unit
    return None


def _section_of_column(
    capture: Capture, name: str, unit: str, root: Root, findings: ImportFindings
) -> AngleSection:
    """Section of a column of angles; unit, sign and zero are estimated from the cable's root."""
    values = capture.column(name)
    best = min(_readings(values, name, unit, root), key=lambda reading: reading.cost)
    word, sign, offset = best.unit, best.sign, best.quarters * np.pi / 2.0
    needs_offset = best.off_rad > root.agrees_rad
    all_values = [values, *_in_other_trials(name, root)]
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
    all_values = [values, *_in_other_trials(name, root)]
    roots_rad = np.array([root.rest_rad, *(shown for c, shown in root.others if name in c.names)])
    largest = max(float(np.nanmax(np.abs(v))) for v in all_values)
    for word in [unit] if unit in RADIANS else ["rad", "deg"]:
        if word == "rad" and unit not in RADIANS and largest > 2.0 * np.pi:
            continue
        turned = [continuous(v * RADIANS[word]) for v in all_values]
        rests_rad = np.array([np.nanmedian(v[: max(1, len(v) // 20)]) for v in turned])
        root_sign = _sign(turned[0], root.angle_rad) or _sign(rests_rad, np.unwrap(roots_rad))
        for sign in (1.0, -1.0) if root_sign == 0.0 else (root_sign,):
            for quarters in (0, -1, 1, 2):
                apart_rad = sign * rests_rad + quarters * np.pi / 2.0 - roots_rad
                off_rad = float(np.mean([abs(wrapped(a)) for a in apart_rad]))
                rest_rad = float(rests_rad[0])
                readings.append(_Reading(word, sign, root_sign != 0.0, quarters, rest_rad, off_rad))
    return readings


def _in_other_trials(name: str, root: Root) -> list[FloatArray]:
    """Values of a column in those files of the other trials that have it."""
    return [c.column(name) for c, _ in root.others if name in c.names]


def _sign(values: FloatArray, shown_rad: FloatArray) -> float:
    """Sign of the correlation of a column of angles with the cable's root; 0 = undetermined."""
    if len(values) != len(shown_rad):
        return 0.0
    good = np.isfinite(values) & np.isfinite(shown_rad)
    turned, shown = values[good], shown_rad[good]
    if len(turned) < 2 or min(np.ptp(turned), np.ptp(shown)) < _MIN_ROTATION:
        return 0.0
    turned = turned - turned.mean()
    slope = float(turned @ (shown - shown.mean()))
    size = float(np.linalg.norm(turned) * np.linalg.norm(shown - shown.mean()))
    return float(np.sign(slope)) if abs(slope) > 0.5 * size else 0.0


def _section_of_body(
    capture: Capture, four: Sequence[str], axes: AxesSection, root: Root, findings: ImportFindings
) -> AngleSection:
    """Section of the body's axis nearest to the direction in which the cable leaves the body.

    w may be the first of the four columns: it is if only then the body rotates as the cable's root.
    """
    section = _along_axis(capture, four, axes, root)
    w_first_section = _along_axis(capture, [*four[1:], four[0]], axes, root)
    mismatch, w_first_mismatch = (
        _mismatch(clamp_angle_rad(capture, each, axes), root) for each in (section, w_first_section)
    )
    w_first = mismatch > _WRONG_ORDER and w_first_mismatch < _RIGHT_ORDER
    section = w_first_section if w_first else section
    assert section.quaternion is not None
    sentence = f"the gripper turns as {section.quaternion[0]!r} … say; the cable leaves along its "
    sentence += f"axis {section.body_axis}{_offset_clause(section.offset_rad)}"
    findings.guessed("hand.angle", sentence)
    if w_first:
        sentence = f"{four[0]!r} is w, x, y and z follow: so it turns as the cable's root"
        findings.guessed("hand.angle", sentence)
    return section


def _mismatch(turned: FloatArray | None, root: Root) -> float:
    """Relative difference between the rotations of a body and the cable's root; 0 = unknown."""
    if turned is None or len(turned) != len(root.angle_rad):
        return 0.0
    good = np.isfinite(turned) & np.isfinite(root.angle_rad)
    if not good.any() or np.ptp(root.angle_rad[good]) < _MIN_ROTATION:
        return 0.0
    x, y = (v[good] - v[good].mean() for v in (root.angle_rad, turned))
    return float(np.linalg.norm(y - x) / np.linalg.norm(x))


def _along_axis(
    capture: Capture, four: Sequence[str], axes: AxesSection, root: Root
) -> AngleSection:
    """The section for columns x, y, z, w."""
    quaternion = capture.at(list(four))
    right, up = (np.append(v, 0.0)[:3] for v in (np.array(axes.right), np.array(axes.up)))
    leaving = -np.cos(root.rest_rad) * right - np.sin(root.rest_rad) * up
    rows = quaternion[np.isfinite(quaternion).all(axis=1)][:1]
    along = {n: float(body_axis(rows, n)[0] @ leaving) if len(rows) else 0.0 for n in BODY_AXES}
    best = max(BODY_AXES, key=lambda n: along[n])
    direction = body_axis(rows, best)[0] if len(rows) else leaving
    offset = wrapped(root.rest_rad - angle_of(np.array([direction @ right, direction @ up])))
    offset = float(round(offset, 4)) if abs(offset) > root.agrees_rad else 0.0
    return AngleSection(quaternion=list(four), body_axis=best, offset_rad=offset)
