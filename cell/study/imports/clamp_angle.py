"""The clamp angle from a file: its column, unit and sign, or the cable's shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, ImportFindings
from cell.study.imports.contents import HAND, Contents, Point
from cell.study.imports.gripper_section import BODY_AXES, AngleSection, AxesSection
from cell.study.imports.places import angle_of, body_axis, clamp_angle_rad, continuous
from cell.study.imports.units import RADIANS
from cell.study.series import wrapped

#: An angle that turns by more tells its sign by how the cable's root turns with it, rad.
_TURNS = 0.05
#: What makes another reading of a column less likely, in radians of disagreement: a negative sign,
#: a quarter turn, a unit that is not stated.
_SIGN, _QUARTER, _UNIT = 0.02, 0.3, 0.05
#: The cable's root and a right reading agree at rest within this, rad; else an offset is needed.
_AGREES = 0.35
#: A body whose turn differs from that of the cable's root by more than the first share of it is not
#: read rightly; by less than the second it is.
_NO_TURN, _SAME_TURN = 0.8, 0.4
#: So near at rest an angle that nothing names is that of the clamp, rad.
_SAME_AT_REST = 0.1
#: The same of a root that only the line to a single marker shows: a cable droops.
_DROOPS = 1.0


@dataclass(frozen=True)
class Root:
    """The clamp angle that the cable shows at its root.

    angle_rad  (rows,) of the markers' file, rough while it moves
    rest_rad   at rest
    is_line    it is that of the line to the only marker, from which a drooping cable departs
    others     of the other trials: the file with the gripper, and `rest_rad`
    """

    angle_rad: FloatArray
    rest_rad: float
    is_line: bool = False
    others: tuple[tuple[Capture, float], ...] = ()

    @property
    def agrees_rad(self) -> float:
        """The root and a right reading agree at rest within this."""
        return _DROOPS if self.is_line else _AGREES


@dataclass(frozen=True)
class _PoseReader:
    """What a column of angles may mean.

    is_measured  the cable shows the sign, by turning with the column, within a trial or between two
    quarters     of a turn that are added
    rest_rad     of the column at rest, in its sign
    off_rad      by which the reading and the cable's root differ at rest, mean over the trials
    """

    unit: str
    sign: float
    is_measured: bool
    quarters: int
    rest_rad: float
    off_rad: float

    @property
    def cost(self) -> float:
        """How unlikely it is."""
        unusual = _SIGN * (self.sign < 0.0) + _QUARTER * (self.quarters != 0)
        return self.off_rad + unusual + _UNIT * (self.unit == "deg")


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

    capture   with the gripper
    findings  those about it are added
    hand      name of the gripping point, by which its columns are known; empty = it has none
    second    another point of the gripper, and the angle of the line to it at rest; None = none
    """
    four = next((q for group, q in inside.quaternions if group == hand), None)
    if four is None and len(inside.quaternions) == 1:
        four = inside.quaternions[0][1]
    if four is not None and _is_filler(capture.at(list(four)), hand):
        four = None
    if four is not None and len(axes.up) == len("xyz"):  # one of three angles is not all of it
        return _of_body(capture, four, axes, root, findings)
    if (column := _column(inside, axes, hand)) is not None:
        return _of_column(capture, *column, root, findings)
    if (column := _agreeing(capture, inside, root)) is not None:
        section = _of_column(capture, *column, root, findings)
        sentence = f"{column[0]!r} is the clamp angle, for it agrees with the cable's root"
        findings.guessed("hand.angle", sentence)
        return section
    if four is not None:
        return _of_body(capture, four, axes, root, findings)
    if second is not None:
        return _of_line(*second, root, hand, findings)
    angle = round(root.rest_rad, 4) + 0.0
    sentence = (
        "no angle of the gripper is in the file: it is taken as constant, "
        f"{np.degrees(angle):.2f}°, as the markers show at rest"
    )
    if root.is_line:
        sentence += "; that is the line to the only marker, from which a cable droops: measure it"
    findings.guessed("hand.angle", sentence)
    return AngleSection(constant_rad=angle)


def _is_filler(quaternion: FloatArray, hand: str) -> bool:
    """Whether a point that is named after no gripper has no turn in all rows: so programs fill the
    poses of points."""
    known = quaternion[np.isfinite(quaternion).all(axis=1)]
    return not HAND.intersection(hand.split()) and bool(np.all(known == [0.0, 0.0, 0.0, 1.0]))


def _of_line(
    second: Point, shown_rad: float, root: Root, hand: str, findings: ImportFindings
) -> AngleSection:
    """The line between two points of the gripper, along the cable or against it."""
    offset = wrapped(root.rest_rad - shown_rad)
    offset = 0.0 if abs(offset) < root.agrees_rad else offset
    if abs(abs(offset) - np.pi) < _AGREES:
        offset = float(np.pi)
    sentence = f"the clamp angle is that of the line between {hand!r} and {second.name!r}"
    findings.guessed("hand.angle", sentence + _turned_by(offset))
    return AngleSection(towards=list(second.columns), offset_rad=round(offset, 10))


def _turned_by(offset_rad: float) -> str:
    """The end of a sentence about an offset, if there is one."""
    degrees = np.degrees(offset_rad)
    return f", turned by {degrees:.0f}° as the cable shows at rest" if offset_rad else ""


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
    name, said = chosen[0]
    return name, said.unit


def _agreeing(capture: Capture, inside: Contents, root: Root) -> tuple[str, str] | None:
    """A column of angles that is of no marker and agrees with the cable's root; None = none."""
    points = {point.name for point in inside.points if not point.on_gripper}
    for name, said in inside.angles:
        if said.group in points or said.axis:
            continue
        best = min(_readings(capture.column(name), name, said.unit, root), key=lambda r: r.cost)
        if best.quarters == 0 and (best.is_measured or best.off_rad < _SAME_AT_REST):
            return name, said.unit
    return None


def _of_column(
    capture: Capture, name: str, unit: str, root: Root, findings: ImportFindings
) -> AngleSection:
    """Unit, sign and zero of a column of angles, by what the cable's root shows."""
    values = capture.column(name)
    best = min(_readings(values, name, unit, root), key=lambda reading: reading.cost)
    word, s, offset = best.unit, best.sign, best.quarters * np.pi / 2.0
    is_off = best.off_rad > root.agrees_rad
    every = [values, *_of_others(name, root)]
    matters = max(float(np.nanmax(np.abs(v))) for v in every) * RADIANS[word] > 1e-3
    which = "positive = down" if s > 0 else "positive = up, turned round"
    why = "the cable turns with it" if best.is_measured else "the cable's root at rest agrees best"
    if not matters:
        why = f"it is 0 throughout {capture.path.name}"
    if best.quarters and not is_off:
        which += f", turned by {90 * best.quarters}°"
    told = findings.seen if best.is_measured or not matters else findings.guessed
    stated = ", as the file says" if unit in RADIANS else ""
    told("hand.angle", f"the clamp angle is column {name!r} in {word}{stated}; {which}: {why}")
    if is_off:
        offset = float(round(wrapped(root.rest_rad - s * best.rest_rad), 4))
        findings.guessed(
            "hand.angle.offset_rad",
            f"{name!r} is {np.degrees(best.off_rad):.0f}° from what the cable shows at rest: an "
            "offset is added",
        )
    factor = round(s * RADIANS[word], 12)
    return AngleSection(column=name, radians_per_unit=factor, offset_rad=round(offset, 10) + 0.0)


def _readings(values: FloatArray, name: str, unit: str, root: Root) -> list[_PoseReader]:
    """All that a column of angles may mean in all trials, the usual ones first."""
    found = []
    every = [values, *_of_others(name, root)]
    roots_rad = np.array([root.rest_rad, *(shown for c, shown in root.others if name in c.names)])
    largest = max(float(np.nanmax(np.abs(v))) for v in every)
    for word in [unit] if unit in RADIANS else ["rad", "deg"]:
        if word == "rad" and unit not in RADIANS and largest > 2.0 * np.pi:
            continue
        turned = [continuous(v * RADIANS[word]) for v in every]
        rests_rad = np.array([np.nanmedian(v[: max(1, len(v) // 20)]) for v in turned])
        seen = _sign(turned[0], root.angle_rad) or _sign(rests_rad, np.unwrap(roots_rad))
        for sign in (1.0, -1.0) if seen == 0.0 else (seen,):
            for quarters in (0, -1, 1, 2):
                apart_rad = sign * rests_rad + quarters * np.pi / 2.0 - roots_rad
                off_rad = float(np.mean([abs(wrapped(a)) for a in apart_rad]))
                rest_rad = float(rests_rad[0])
                found.append(_PoseReader(word, sign, seen != 0.0, quarters, rest_rad, off_rad))
    return found


def _of_others(name: str, root: Root) -> list[FloatArray]:
    """Values of a column in the other trials' files that have it and are known there."""
    return [c.column(name) for c, _ in root.others if name in c.names]


def _sign(values: FloatArray, shown_rad: FloatArray) -> float:
    """Whether the cable's root turns with a column of angles or against it; 0 = it hardly turns."""
    if len(values) != len(shown_rad):
        return 0.0
    good = np.isfinite(values) & np.isfinite(shown_rad)
    turned, shown = values[good], shown_rad[good]
    if len(turned) < 2 or min(np.ptp(turned), np.ptp(shown)) < _TURNS:
        return 0.0
    turned = turned - turned.mean()
    slope = float(turned @ (shown - shown.mean()))
    size = float(np.linalg.norm(turned) * np.linalg.norm(shown - shown.mean()))
    return float(np.sign(slope)) if abs(slope) > 0.5 * size else 0.0


def _of_body(
    capture: Capture, four: Sequence[str], axes: AxesSection, root: Root, findings: ImportFindings
) -> AngleSection:
    """The axis of a body that is nearest to the direction in which the cable leaves it.

    Of four numbers w may be the first: so it is if only then the body turns as the cable's root.
    """
    section = _along_axis(capture, four, axes, root)
    other = _along_axis(capture, [*four[1:], four[0]], axes, root)
    turns, as_other = (
        _turn(clamp_angle_rad(capture, each, axes), root) for each in (section, other)
    )
    w_first = turns > _NO_TURN and as_other < _SAME_TURN
    section = other if w_first else section
    assert section.quaternion is not None
    sentence = f"the gripper turns as {section.quaternion[0]!r} … say; the cable leaves along its "
    sentence += f"axis {section.body_axis}{_turned_by(section.offset_rad)}"
    findings.guessed("hand.angle", sentence)
    if w_first:
        sentence = f"{four[0]!r} is w, x, y and z follow: so it turns as the cable's root"
        findings.guessed("hand.angle", sentence)
    return section


def _turn(turned: FloatArray | None, root: Root) -> float:
    """By which share a body's turn differs from that of the cable's root; 0 = nothing shows it."""
    if turned is None or len(turned) != len(root.angle_rad):
        return 0.0
    good = np.isfinite(turned) & np.isfinite(root.angle_rad)
    if not good.any() or np.ptp(root.angle_rad[good]) < _TURNS:
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
    seen = body_axis(rows, best)[0] if len(rows) else leaving
    offset = wrapped(root.rest_rad - angle_of(np.array([seen @ right, seen @ up])))
    offset = float(round(offset, 4)) if abs(offset) > root.agrees_rad else 0.0
    return AngleSection(quaternion=list(four), body_axis=best, offset_rad=offset)
