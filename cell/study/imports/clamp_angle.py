"""The clamp angle from a file: its column, unit and sign, or the cable's shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError
from cell.study.imports.body_orientation import (
    angles_of_gripper,
    forms_of_four,
    forms_of_three,
    offset_clause,
    quaternion_of,
    section_of_body,
)
from cell.study.imports.cable_root import MIN_ROTATION, Root, first_rows, turn_signs
from cell.study.imports.capture import Capture, CapturedColumn, ImportFindings, Sure
from cell.study.imports.column_names import Meaning, meaning
from cell.study.imports.contents import HAND, Contents, Point
from cell.study.imports.gripper_section import AngleSection, AxesSection, GripperSection
from cell.study.imports.places import angle_towards, clamp_angle_rad, continuous, places_m
from cell.study.imports.units import RADIANS
from cell.study.series import wrapped

#: Largest angle of a clamp in a study, rad.
MOST_RAD = 2.0 * np.pi
#: Penalties of less usual interpretations of a column, rad: a negative sign, a quarter turn, a unit
#: that is not stated.
_SIGN_COST, _QUARTER_COST, _UNIT_COST = 0.02, 0.3, 0.05
#: An unnamed angle is the clamp's if it is within this of the root at rest, rad.
_SAME_AT_REST = 0.1
#: … and a measured one agrees with a stated one within this, rad.
_SAME_AS_STATED = 0.01
#: Number of medians of a trial by which a gripper that does not turn is recognized.
_BLOCKS = 50


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
    four, spatial = quaternion_of(capture, inside, hand), len(axes.up) == len("xyz")
    if four is not None and spatial:  # one angle is no 3D orientation
        return _section_of_four(capture, four, axes, root, findings)
    angles = tuple(f for f in inside.angles if not _is_heading(capture, inside, *f))
    inside = replace(inside, angles=angles)
    groups = list(forms_of_three(capture, inside, hand)) if spatial else []
    for forms in groups:
        if section := section_of_body(capture, forms, axes, root, findings):
            return section
    if groups:
        return _no_angle(" … ".join(groups[0][0].rotation or []), findings)
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
        findings.guessed("hand.angle", sentence + offset_clause(offset, root))
        return AngleSection(towards=list(point.columns), offset_rad=round(offset, 10))
    angle = round(root.rest_rad, 4) + 0.0
    sentence = "no angle of the gripper is in the file: it is taken as constant, "
    sentence += f"{np.degrees(angle):.2f}° ± {np.degrees(root.clamp_std_rad):.1f}°, as the markers "
    sentence += "show at rest"
    if root.is_line:
        sentence += "; that is the line to the only marker, from which a cable droops: measure it"
    sentence += "; a measured angle is stated by --clamp-angle"
    findings.guessed("hand.angle", sentence)
    return AngleSection(constant_rad=angle)


def stated_angle(
    captures: Sequence[Capture],
    hand: GripperSection,
    axes: AxesSection,
    stated_rad: float | None,
    root: Root,
    findings: ImportFindings,
) -> GripperSection:
    """The gripper with the clamp angle that the user states; None = nothing is stated.

    It takes the place of what is estimated from the cable: of a constant angle, or of the offset to
    a direction of the gripper that does not turn.

    captures  files with the gripper, one a trial
    axes      of the markers
    root      of the cable at rest
    findings  those about the angle are replaced
    raises    InputError: a column of the gripper has the angle, the gripper turns, or the cable
              contradicts the statement
    """
    if stated_rad is None:
        return hand
    path, angle = captures[0].path, f"{np.degrees(stated_rad):.2f}°"
    option = f"--clamp-angle states {np.degrees(stated_rad):.1f}°"
    about = [f for f in findings if f.entry.startswith("hand.angle")]
    guessed = all(f.sure is Sure.GUESSED for f in about) and not _is_of_gripper(hand)
    shown_rad = None if guessed else _constant_direction(captures, hand, hand.axes or axes)
    if hand.angle.constant_rad is not None or hand.angle == AngleSection() or guessed:
        section = AngleSection(constant_rad=stated_rad)
        sentence = f"the clamp angle is {angle}, constant, as --clamp-angle says"
    elif shown_rad is not None:
        offset = wrapped(hand.angle.offset_rad + stated_rad - shown_rad)
        section = hand.angle.model_copy(update={"offset_rad": round(offset, 10) + 0.0})
        sentence = f"the clamp angle is {angle} at rest, as --clamp-angle says: that fixes the "
        sentence += "offset to the gripper's direction, which hardly turns"
    else:
        found = "; ".join(f.sentence for f in about if f.entry == "hand.angle")
        values = clamp_angle_rad(captures[0], hand.angle, hand.axes or axes)
        known = np.empty(0) if values is None else values[np.isfinite(values)]
        remedy = "leave the option out"
        if len(known):
            rest_rad = float(np.median(first_rows(known)))
            turns = float(np.ptp(continuous(known))) > MIN_ROTATION
            if not turns and abs(wrapped(rest_rad - stated_rad)) < _SAME_AS_STATED:
                findings.stated("hand.angle", f"at rest it is {angle}, as --clamp-angle says")
                return hand
            offset = wrapped(hand.angle.offset_rad + stated_rad - rest_rad)
            remedy += f", and give offset_rad: {offset:.4g} in the mapping if it is that at rest"
        raise InputError.at(path, f"{option}, but {found}; {remedy}")
    if abs(wrapped(root.rest_rad - stated_rad)) > root.agrees_rad:
        shown, limit = np.degrees([root.rest_rad, root.agrees_rad])
        message = f"{option}, but at rest the cable leaves the gripper at {shown:.1f}°, limit "
        message += f"{limit:.0f}° apart; 0 = level, positive = tip down: correct the option, or "
        message += "leave it out and check the `axes` of the proposal"
        raise InputError.at(path, message)
    findings[:] = [f for f in findings if f not in about]
    findings.stated("hand.angle", sentence)
    return hand.model_copy(update={"angle": section})


def _constant_direction(
    captures: Sequence[Capture], hand: GripperSection, axes: AxesSection
) -> float | None:
    """Angle of a gripper whose orientation is measured, but hardly changes; None = it turns."""
    angle, medians = hand.angle, []
    names = [*(angle.quaternion or angle.rotation or angle.towards or ()), *(hand.columns or ())]
    for capture in captures:
        if angle.column is not None or not {n for n in names if n} <= set(capture.names):
            return None
        values = clamp_angle_rad(capture, angle, axes)
        if values is None and angle.towards and hand.columns:
            start, end = (places_m(capture, c, axes, 1.0) for c in (hand.columns, angle.towards))
            values = angle_towards(start, end, angle.offset_rad)
        known = np.empty(0) if values is None else values[np.isfinite(values)]
        if not len(known):
            return None
        blocks = np.array_split(known, min(_BLOCKS, len(known)))
        medians += [float(np.median(first_rows(known))), *(float(np.median(b)) for b in blocks)]
    turned = np.unwrap(medians)
    return medians[0] if np.ptp(turned) < MIN_ROTATION else None


def _is_of_gripper(hand: GripperSection) -> bool:
    """Whether the angle is in the gripper's own file, or in columns named after it."""
    angle = hand.angle
    turning = (angle.quaternion, angle.rotation, angle.towards)
    names = [angle.column or "", *(name for columns in turning for name in columns or ())]
    words = {word for name in names for word in meaning(CapturedColumn(name)).group.split()}
    return hand.time is not None or bool(angle.follows or HAND & words)


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


def _column(inside: Contents, axes: AxesSection, hand: str) -> tuple[str, Meaning] | None:
    """The column of the clamp angle: the gripper's, about the normal of the plane."""
    chosen = angles_of_gripper(inside, hand)
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
        readings = _readings(capture, name, of.unit, root)
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
    unit = of.unit
    readings = _readings(capture, name, unit, root)
    if not readings and of.axis:
        return _no_angle(name, findings)
    if not readings:
        readings = _readings(capture, name, unit, Root(np.empty(0), root.rest_rad))
        sentence = f"the cable's root does not turn by as much as {name!r}: check both"
        findings.guessed("hand.angle", sentence)
    best = min(readings, key=lambda reading: reading.cost)
    word, sign, offset = best.unit, best.sign, best.quarters * np.pi / 2.0
    needs_offset = best.off_rad > root.agrees_rad
    captures = [capture, *(e.capture for e in root.others if name in e.capture.names)]
    all_values = [c.column(name) for c in captures]
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


def _readings(capture: Capture, name: str, unit: str, root: Root) -> list[_Reading]:
    """All interpretations of a column of angles over all trials, the usual ones first."""
    readings = []
    others = [e for e in root.others if name in e.capture.names]
    all_values = [capture.column(name), *(e.capture.column(name) for e in others)]
    roots_rad = np.array([root.rest_rad, *(e.first_rad for e in others)])
    largest = max(float(np.nanmax(np.abs(v))) for v in all_values)
    for word in [unit] if unit in RADIANS else ["rad", "deg"]:
        if word == "rad" and unit not in RADIANS and largest > 2.0 * np.pi:
            continue
        turned = [continuous(v * RADIANS[word]) for v in all_values]
        rests_rad = np.array([np.nanmedian(first_rows(v)) for v in turned])

        def angle_of_file(of: Capture, factor: float = RADIANS[word]) -> FloatArray | None:
            return continuous(of.column(name) * factor) if name in of.names else None

        signs = turn_signs(angle_of_file, capture, root)
        for sign in signs:
            for quarters in (0, -1, 1, 2):
                apart_rad = sign * rests_rad + quarters * np.pi / 2.0 - roots_rad
                off_rad = float(np.mean([abs(wrapped(a)) for a in apart_rad]))
                sure, rest_rad = len(signs) == 1, float(rests_rad[0])
                readings.append(_Reading(word, sign, sure, quarters, rest_rad, off_rad))
    return readings


def _no_angle(name: str, findings: ImportFindings) -> AngleSection:
    """The section that the user must fill in, for the cable's root turns otherwise."""
    sentence = f"{name!r} does not turn by as much as the cable's root: it is not the clamp angle; "
    findings.missing("hand.angle", f"{sentence}give hand.angle, or --clamp-angle")
    return AngleSection()


def _section_of_four(
    capture: Capture, four: Sequence[str], axes: AxesSection, root: Root, findings: ImportFindings
) -> AngleSection:
    """Section of a quaternion; to fill in if it does not turn as the root."""
    section = section_of_body(capture, forms_of_four(capture, four), axes, root, findings)
    if section is not None and section.quaternion != [*four]:
        sentence = f"{four[0]!r} is w, x, y and z follow: so it turns as the cable's root"
        findings.guessed("hand.angle", sentence)
    return section or _no_angle(four[0], findings)
