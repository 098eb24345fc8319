"""What is proposed for a hand that a file tells by an encoder or an accelerometer."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.study.imports.capture import Capture
from cell.study.imports.column_names import Meaning
from cell.study.imports.contents import Contents
from cell.study.imports.finding import Finding, Sure
from cell.study.imports.hand_pose import Root, clamp_angle
from cell.study.imports.hand_section import (
    AccelerationSection,
    AngleSection,
    AxesSection,
    HandSection,
    TurnsSection,
    wanted_of_hand,
)
from cell.study.imports.units import METRES, RADIANS

#: m/s² that one of a unit is, and standard gravity within this share tells an unnamed one.
ACCELERATIONS = {"m/s^2": 1.0, "mm/s^2": 1e-3, "g": 9.80665}
_WITHIN = 0.1
#: Rows in which a hand rests at first.
_REST = 20


def hand_by_sensor(
    capture: Capture,
    inside: Contents,
    axes: AxesSection,
    root: Root,
    of_file: dict[str, Any],
) -> tuple[HandSection, list[Finding]]:
    """The hand's section with null where somebody must fill it in, and why.

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
        section = HandSection(columns=columns, axes=plane, metres_per_unit=unit, angle=angle)
        findings += told
    else:
        section, findings = _turning(capture, inside, axes, root)
    section = section.model_copy(update=of_file)
    findings += [
        Finding("hand", f"give {'.'.join(map(str, key))}: {remedy}", Sure.WANTED)
        for key, remedy in wanted_of_hand(section)
    ]
    return section, findings


def _linear(inside: Contents) -> tuple[list[str | None], list[Finding]]:
    """Columns of axes that move the hand straight; null = it stays along this one."""
    by_axis = {m.axis or "x": name for name, m in reversed(inside.encoders)}
    columns: list[str | None] = [by_axis.get("x"), by_axis.get("y") or by_axis.get("z")]
    names = " and ".join(repr(c) for c in columns if c is not None)
    sentence = f"{names} tells the hand's place; along null it stays at hand.origin_m"
    return columns, [Finding("hand", f"{sentence}: does it move right, or up?", Sure.GUESSED)]


def _turning(
    capture: Capture, inside: Contents, axes: AxesSection, root: Root
) -> tuple[HandSection, list[Finding]]:
    name, said = next((n, m) for n, m in inside.encoders if m.unit not in METRES)
    unit = RADIANS.get(said.unit)
    turns = TurnsSection(column=name, radians_per_unit=unit, axle_m=None, radius_m=None)
    sentence = f"no place of the hand is in {capture.path.name}: {name!r} tells how its arm turns"
    findings = [Finding("hand", sentence, Sure.GUESSED)]
    if not inside.angles:
        sentence = (
            "the clamp turns with the arm, and the cable leaves along it; else give offset_rad"
        )
        findings.append(Finding("hand.angle", sentence, Sure.GUESSED))
        return HandSection(turns=turns, angle=AngleSection(follows=True)), findings
    angle, told = clamp_angle(capture, inside, axes, root, None, "")
    return HandSection(turns=turns, angle=angle), [*findings, *told]


def _by_acceleration(
    capture: Capture, inside: Contents, axes: AxesSection, root: Root
) -> tuple[HandSection, list[Finding]]:
    """Which of the columns is up, by gravity at rest, and their unit."""
    found: tuple[tuple[str, Meaning], ...] = inside.accelerations[:3]
    names = [n for n, _ in found]
    columns: list[str | None] = [*names, *[None] * (2 - len(names))]
    rest = np.nanmedian(capture.at(names)[:_REST], axis=0)
    size = float(np.linalg.norm(rest))
    unit, sure, why = _unit(found[0][1].unit, size)
    shows_gravity = unit is None or size * unit > 0.5 * ACCELERATIONS["g"]
    own, sentence = _axes(capture, names, rest, shows_gravity)
    said = f"no place of the hand is in {capture.path.name}: it is integrated from acceleration, "
    findings = [Finding("hand", f"{said}columns {', '.join(names)}; {sentence}", Sure.GUESSED)]
    findings.append(Finding("hand.acceleration", f"acceleration is {why}", sure))
    sensor = AccelerationSection(
        columns=columns, m_per_s2_per_unit=unit, along="clamp", starts_at_m=None
    )
    angle, told = clamp_angle(capture, inside, axes, root, None, "")
    return HandSection(acceleration=sensor, axes=own, angle=angle), [*findings, *told]


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
