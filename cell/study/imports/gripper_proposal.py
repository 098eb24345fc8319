"""Proposed mapping of a gripper with its own file, an encoder or an accelerometer."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, Finding, Sure
from cell.study.imports.choosing import columns_finding, detected_places
from cell.study.imports.clamp_angle import Root, clamp_angle
from cell.study.imports.column_names import Meaning
from cell.study.imports.contents import Contents, Point, contents
from cell.study.imports.gripper_section import (
    AccelerationSection,
    AngleSection,
    AxesSection,
    GripperSection,
    TextSection,
    TurnsSection,
    entries_to_fill_in,
)
from cell.study.imports.scales import time_section
from cell.study.imports.shape import AWAY, FEWEST_REST, arc_lengths, reach_of
from cell.study.imports.units import METRES, RADIANS

#: m/s² that one of a unit is, and standard gravity within this share tells an unnamed one.
ACCELERATIONS = {"m/s^2": 1.0, "mm/s^2": 1e-3, "g": 9.80665}
_WITHIN = 0.1
#: Rows in which a gripper rests at first.
_REST = 20


def sensor_section(
    capture: Capture,
    inside: Contents,
    axes: AxesSection,
    root: Root,
    of_file: dict[str, Any],
) -> tuple[GripperSection, list[Finding]]:
    """The gripper's section for an encoder or accelerometer, null where the user must fill it in.

    axes     of the markers
    of_file  entries of the section that are of a file of its own
    """
    if not inside.encoders:
        section, findings = _by_acceleration(capture, inside, axes, root)
    elif all(m.unit in METRES for _, m in inside.encoders):
        columns, findings = _linear(inside)
        plane = AxesSection(right=[1.0, 0.0], up=[0.0, 1.0])
        angle, told = clamp_angle(capture, inside, plane, root, None, "")
        unit = METRES[inside.encoders[0][1].unit]
        section = GripperSection(columns=columns, axes=plane, metres_per_unit=unit, angle=angle)
        findings += told
    else:
        section, findings = _turning(capture, inside, axes, root)
    section = section.model_copy(update=of_file)
    findings += [
        Finding("hand", f"give {'.'.join(map(str, key))}: {remedy}", Sure.WANTED)
        for key, remedy in entries_to_fill_in(section)
    ]
    return section, findings


def _linear(inside: Contents) -> tuple[list[str | None], list[Finding]]:
    """Columns of axes that move the gripper straight; null = it stays along this one."""
    by_axis = {m.axis or "x": name for name, m in reversed(inside.encoders)}
    columns: list[str | None] = [by_axis.get("x"), by_axis.get("y") or by_axis.get("z")]
    names = " and ".join(repr(c) for c in columns if c is not None)
    sentence = f"{names} tells the gripper's place; along null it stays at hand.origin_m"
    return columns, [Finding("hand", f"{sentence}: does it move right, or up?", Sure.GUESSED)]


def _turning(
    capture: Capture, inside: Contents, axes: AxesSection, root: Root
) -> tuple[GripperSection, list[Finding]]:
    name, said = next((n, m) for n, m in inside.encoders if m.unit not in METRES)
    unit = RADIANS.get(said.unit)
    turns = TurnsSection(column=name, radians_per_unit=unit, axle_m=None, radius_m=None)
    sentence = (
        f"no place of the gripper is in {capture.path.name}: {name!r} tells how its arm turns"
    )
    findings = [Finding("hand", sentence, Sure.GUESSED)]
    if not inside.angles:
        sentence = (
            "the clamp turns with the arm, and the cable leaves along it; else give offset_rad"
        )
        findings.append(Finding("hand.angle", sentence, Sure.GUESSED))
        return GripperSection(turns=turns, angle=AngleSection(follows=True)), findings
    angle, told = clamp_angle(capture, inside, axes, root, None, "")
    return GripperSection(turns=turns, angle=angle), [*findings, *told]


def _by_acceleration(
    capture: Capture, inside: Contents, axes: AxesSection, root: Root
) -> tuple[GripperSection, list[Finding]]:
    """Which of the columns is up, by gravity at rest, and their unit."""
    found: tuple[tuple[str, Meaning], ...] = inside.accelerations[:3]
    names = [n for n, _ in found]
    columns: list[str | None] = [*names, *[None] * (2 - len(names))]
    rest = np.nanmedian(capture.at(names)[:_REST], axis=0)
    size = float(np.linalg.norm(rest))
    unit, sure, why = _unit(found[0][1].unit, size)
    shows_gravity = unit is None or size * unit > 0.5 * ACCELERATIONS["g"]
    own, sentence = _axes(capture, names, rest, shows_gravity)
    said = (
        f"no place of the gripper is in {capture.path.name}: it is integrated from acceleration, "
    )
    findings = [Finding("hand", f"{said}columns {', '.join(names)}; {sentence}", Sure.GUESSED)]
    findings.append(Finding("hand.acceleration", f"acceleration is {why}", sure))
    sensor = AccelerationSection(
        columns=columns, m_per_s2_per_unit=unit, along="clamp", starts_at_m=None
    )
    angle, told = clamp_angle(capture, inside, axes, root, None, "")
    return GripperSection(acceleration=sensor, axes=own, angle=angle), [*findings, *told]


def _unit(stated: str, size: float) -> tuple[float | None, Sure, str]:
    """m/s² a unit, how sure, and why; size at rest in the file's unit."""
    if stated in ACCELERATIONS:
        return ACCELERATIONS[stated], Sure.SAID, f"in {stated}, as the file says"
    for name, unit in ACCELERATIONS.items():
        if abs(size * unit / ACCELERATIONS["g"] - 1.0) < _WITHIN:
            return unit, Sure.GUESSED, f"in {name}: it is {size:.4g} at rest"
    return None, Sure.WANTED, f"in a unit that is not known: it is {size:.4g} at rest"


def _axes(
    capture: Capture, names: list[str], rest: np.ndarray, shows_gravity: bool
) -> tuple[AxesSection, str]:
    """The sensor's directions: up shows gravity at rest, right moves the most of the others."""
    count = max(2, len(names))
    right, up = np.zeros(count), np.zeros(count)
    k = int(np.argmax(np.abs(rest))) if shows_gravity else min(1, len(names) - 1)
    if len(names) == 1:
        k = 0 if shows_gravity else 1
    up[k] = np.sign(rest[k]) if shows_gravity else 1.0
    moves = np.full(count, -1.0)
    moves[: len(names)] = np.nanstd(capture.at(names), axis=0)
    moves[k] = -2.0
    other = int(np.argmax(moves))
    right[other] = 1.0
    shown = names[k] if k < len(names) else "none of these"
    why = "it shows gravity at rest" if shows_gravity else "none shows gravity at rest"
    return AxesSection(right=right.tolist(), up=up.tolist()), f"up is {shown}: {why}"


#: A gripper moves along one axis if it moves by less than this share of that across it.
_LEVEL = 0.02
#: A chain from the gripper on is the cable's if it is longer than the free length by this share at
#: most; where no unit is stated, and shorter by that.
TIP, _SHORTER = 0.02, 0.3
#: Of a gripper's distances from its first place: what is beyond are single wrong rows.
_MOST = 0.95


@dataclass(frozen=True, eq=False)
class GripperFile:
    """A file of the gripper.

    point    the gripping point; None = it has none
    initial  (d,) where that rests at first, in the file's unit and axes; None = it never does
    """

    capture: Capture
    inside: Contents
    point: Point | None
    initial: FloatArray | None


def gripper_file(capture: Capture) -> GripperFile:
    """The content of a file of the gripper."""
    inside = contents(capture)
    named = [p for p in inside.points if p.on_gripper] or list(inside.points)
    named.sort(key=lambda p: "actual" not in p.name.split())  # before what was only commanded
    if not named:
        return GripperFile(capture, inside, None, None)
    return GripperFile(
        capture, inside, named[0], _initial_place(detected_places(capture, named[0].columns, ()))
    )


def _initial_place(places: FloatArray) -> FloatArray | None:
    """(d,) where a point (rows, d) is until it moves; None if it does so from the first row on."""
    seen = places[np.isfinite(places).all(axis=1)]
    if len(seen) < FEWEST_REST:
        return None
    away = np.linalg.norm(seen - np.median(seen[:FEWEST_REST], axis=0), axis=1)
    moves = away > AWAY * np.quantile(away, _MOST)
    rests = int(np.argmax(moves)) if moves.any() else len(seen)
    return np.asarray(np.median(seen[:rests], axis=0)) if rests >= FEWEST_REST else None


def first_point(
    hand: GripperFile, shape: FloatArray, units: Set[str], free_length_m: float | None
) -> FloatArray | None:
    """(d,) where the gripper rests, in the markers' unit, if both are in one frame; None if not.

    They are if the chain from the gripper on is no longer than the cable.

    shape   (points, d) of the markers at rest, from the gripper to the tip, in the file's unit
    units   that the file states for them
    """
    point, rest = hand.point, hand.initial
    if free_length_m is None or point is None or rest is None or len(rest) != shape.shape[1]:
        return None
    stated = next((u for u in sorted(units) if u in METRES), "")
    for unit in [stated] if stated else METRES:
        place = rest * (METRES[point.unit] / METRES[unit] if point.unit in METRES else 1.0)
        chain_m = METRES[unit] * float(arc_lengths(np.vstack([place, shape])[None])[-1])
        least_m = 0.0 if stated else free_length_m / (1.0 + _SHORTER)
        if least_m <= chain_m <= free_length_m * (1.0 + TIP):
            return np.asarray(place)
    return None


#: The marker next to the gripper moves about as far as the gripper; so many times more or less is
#: another unit.
_AS_FAR = 5.0


@dataclass(frozen=True, eq=False)
class NearestMarker:
    """Motion of the marker next to the gripper, in the trial whose gripper moves most.

    hand  (rows, d) of that trial's gripper, in the unit and axes of its file
    xy_m  (frames, 2) of the marker in the study's plane
    """

    hand: FloatArray
    xy_m: FloatArray


def section_of_file(
    hand: GripperFile,
    axes: AxesSection,
    root: Root,
    scale: float | None,
    nearest: NearestMarker | None,
) -> tuple[GripperSection, list[Finding]]:
    """The section of a gripper with a file of its own; without a place where it tells none.

    nearest  None = the markers' unit or the gripper's place is not known
    """
    capture, inside, point = hand.capture, hand.inside, hand.point
    time, told = time_section(capture, inside, None)
    of_file: dict[str, Any] = {"text": TextSection.of(capture), "time": time}
    if point is None and inside.has_gripper_sensor:
        section, findings = sensor_section(capture, inside, axes, root, of_file)
        return section, [*told, *findings]
    if point is None:
        sentence = (
            f"no place of the gripper is known in {capture.path.name}: name two columns of it "
        )
        sentence += "as hand.columns, that of its axle's encoder in hand.turns, or those of an "
        sentence += "accelerometer on it in hand.acceleration"
        findings = [Finding("hand", sentence, Sure.WANTED), columns_finding(capture)]
        return GripperSection(angle=AngleSection(), **of_file), [*told, *findings]
    sentence = f"{point.name!r} of {capture.path.name} is the gripping point"
    findings = [Finding("hand", sentence, Sure.GUESSED)]
    own = None
    if len(point.columns) != len(axes.up):
        own, sentence = _own_axes(detected_places(capture, point.columns, ()), nearest)
        findings.append(Finding("hand.axes", sentence, Sure.GUESSED))
    unit, finding = _unit_of_place(point, scale, nearest)
    of_this = [*told, *([finding] if finding else [])]
    findings += [replace(f, sentence=f"{capture.path.name}: {f.sentence}") for f in of_this]
    angle, told = clamp_angle(capture, inside, own or axes, root, None, point.name)
    section = GripperSection(
        columns=list(point.columns),
        angle=angle,
        metres_per_unit=unit,
        axes=own,
        **of_file,
    )
    return section, [*findings, *told]


def _unit_of_place(
    point: Point, scale: float | None, nearest: NearestMarker | None
) -> tuple[float | None, Finding | None]:
    """Metres a unit of the gripper's place; the marker next to it moves as far.

    scale  of the markers
    """
    seen_m = 0.0 if nearest is None else reach(nearest.xy_m)
    moves = 0.0 if nearest is None else reach(nearest.hand)
    stated = METRES.get(point.unit)
    names = {METRES[n]: n for n in ("m", "mm", "cm", "in")}
    tried = [u for u in (scale, *names) if u is not None]
    fitting = [u for u in tried if moves > 0.0 and 1 / _AS_FAR < u * moves / seen_m < _AS_FAR]
    if not moves > 0.0 or not seen_m > 0.0 or not fitting:
        if stated is not None:
            return stated, Finding("hand", f"lengths are in {point.unit}, as it says", Sure.SAID)
        return scale, Finding(
            "hand", "its unit of length is taken as that of the markers", Sure.GUESSED
        )
    unit = fitting[0]
    said = f"in {names.get(unit, f'{unit:g} m')} it moves by {unit * moves:.3g} m, the marker next "
    said += f"to it by {seen_m:.3g} m"
    if stated is None:
        return unit, Finding("hand.metres_per_unit", f"{said}: so that is its unit", Sure.SEEN)
    if 1 / _AS_FAR < stated * moves / seen_m < _AS_FAR:
        return stated, Finding("hand", f"lengths are in {point.unit}, as it says", Sure.SAID)
    sentence = f"it says {point.unit}, and would move by {stated * moves:.3g} m, yet {said}; give "
    return stated, Finding(
        "hand.metres_per_unit", f"{sentence}hand.metres_per_unit: {unit:g}", Sure.WANTED
    )


def _own_axes(places: FloatArray, nearest: NearestMarker | None) -> tuple[AxesSection, str]:
    """Right and up along the columns of a gripper that are not as many as a marker's.

    A robot's third axis is up.  Right is the level direction in which the gripper moves, towards
    the same side as the marker next to it.
    """
    if places.shape[1] == 2:
        plane = AxesSection(right=[1.0, 0.0], up=[0.0, 1.0])
        return plane, "the gripper's file has its own axes: right and up are its first and second"
    seen = places[np.isfinite(places).all(axis=1)]
    span = np.ptp(seen, axis=0) if len(seen) else np.zeros(3)
    sentence = "the gripper's file has its own axes: up is its third"
    right = np.array([1.0, 0.0, 0.0])
    if np.hypot(*span[:2]) <= _LEVEL * span[2]:
        return _plane_of(right), f"{sentence}; it only moves along that: right is its first"
    level = seen[:, :2] - seen[:, :2].mean(axis=0)
    right[:2] = np.linalg.svd(level, full_matrices=False)[2][0]
    if nearest is not None:
        hand, marker = (v[np.isfinite(v).all(axis=1)] for v in (nearest.hand, nearest.xy_m))
        goes = (hand[-1] - hand[0]) @ right
        right *= -1.0 if goes * (marker[-1, 0] - marker[0, 0]) < 0.0 else 1.0
    return _plane_of(right), f"{sentence}, right the level direction in which it moves"


def _plane_of(right: FloatArray) -> AxesSection:
    return AxesSection(right=[round(float(v), 7) + 0.0 for v in right], up=[0.0, 0.0, 1.0])


def reach(places: FloatArray) -> float:
    """Span of the middle 98 % of positions (rows, d); 0 if none is seen."""
    return float(np.nan_to_num(reach_of(places, 0.01)))
