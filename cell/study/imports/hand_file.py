"""A hand in a file of its own: which point it is, where it rests before its cable, its angle."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture
from cell.study.imports.choosing import seen_places
from cell.study.imports.contents import Contents, Point, contents
from cell.study.imports.finding import Finding, Sure
from cell.study.imports.hand_pose import Root, clamp_angle
from cell.study.imports.hand_section import AxesSection, HandSection, TextSection
from cell.study.imports.scales import metres_per_unit, time_section
from cell.study.imports.sensed_hand import hand_by_sensor
from cell.study.imports.shape import AWAY, FEWEST_REST, arc_lengths
from cell.study.imports.units import METRES

#: A chain from the hand on is the cable's if it is longer than the free length by this share at
#: most; where no unit is stated, and shorter by that.
TIP, _SHORTER = 0.02, 0.3
#: Of a hand's distances from its first place: what is beyond are single wrong rows.
_MOST = 0.95


@dataclass(frozen=True, eq=False)
class HandFile:
    """A file of the hand.

    point  the gripping point; None = it has none
    rest   (d,) where that rests at first, in the file's unit and axes; None = it never does
    """

    capture: Capture
    inside: Contents
    point: Point | None
    rest: FloatArray | None


def hand_file(capture: Capture) -> HandFile:
    """What a file of the hand holds."""
    inside = contents(capture)
    named = [p for p in inside.points if p.of_hand] or list(inside.points)
    if not named:
        return HandFile(capture, inside, None, None)
    return HandFile(capture, inside, named[0], _at_rest(seen_places(capture, named[0].columns, ())))


def _at_rest(places: FloatArray) -> FloatArray | None:
    """(d,) where a point (rows, d) is until it moves; None if it does so from the first row on."""
    seen = places[np.isfinite(places).all(axis=1)]
    if len(seen) < FEWEST_REST:
        return None
    away = np.linalg.norm(seen - np.median(seen[:FEWEST_REST], axis=0), axis=1)
    moves = away > AWAY * np.quantile(away, _MOST)
    rests = int(np.argmax(moves)) if moves.any() else len(seen)
    return np.asarray(np.median(seen[:rests], axis=0)) if rests >= FEWEST_REST else None


def first_point(
    hand: HandFile, shape: FloatArray, units: Set[str], free_length_m: float | None
) -> FloatArray | None:
    """(d,) where the hand rests, in the markers' unit, if both are in one frame; None if not.

    They are if the chain from the hand on is no longer than the cable.

    shape   (points, d) of the markers at rest, from the hand to the tip, in the file's unit
    units   that the file states for them
    """
    point, rest = hand.point, hand.rest
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


def hand_elsewhere(
    hand: HandFile, axes: AxesSection, root: Root, scale: float | None
) -> tuple[HandSection, list[Finding]]:
    """The section of a hand with a file of its own.  Raises InputError: it tells no hand."""
    capture, inside, point = hand.capture, hand.inside, hand.point
    time, told = time_section(capture, inside, None)
    form = capture.form
    text = None if form is None else TextSection(separator=form.separator, decimal=form.decimal)
    of_file: dict[str, Any] = {"text": text, "time": time}
    if point is None and inside.senses_hand:
        section, findings = hand_by_sensor(capture, inside, axes, root, of_file)
        return section, [*told, *findings]
    if point is None:
        message = (
            "has no x and y of the hand; name two columns as hand_x and hand_y, that of its axle's "
            "encoder as encoder, or those of an accelerometer on it as acc_x and acc_y. Columns: "
        )
        raise capture.error(0, f"{message}{', '.join(capture.names[:12])}")
    sentence = f"{point.name!r} of {capture.path.name} is the gripping point"
    findings = [Finding("hand", sentence, Sure.GUESSED)]
    same = len(point.columns) == len(axes.up)
    own = None if same else AxesSection(right=[1.0, 0.0], up=[0.0, 1.0])
    if not same:
        sentence = "the hand's file has its own axes: right and up are its first and second"
        findings.append(Finding("hand.axes", sentence, Sure.GUESSED))
    at = seen_places(capture, point.columns, ())
    extent = float(np.nanmax(np.abs(at)))
    unit, finding = metres_per_unit({point.unit}, extent, None) if point.unit else (scale, None)
    of_this = [*told, *([finding] if finding else [])]
    findings += [replace(f, sentence=f"{capture.path.name}: {f.sentence}") for f in of_this]
    angle, told = clamp_angle(capture, inside, axes, root, None, point.name)
    section = HandSection(
        columns=list(point.columns),
        angle=angle,
        metres_per_unit=unit,
        axes=own,
        **of_file,
    )
    return section, [*findings, *told]
