"""What files of one kind say and show: a mapping proposed from the first of them, and how sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.study.entries import MAX_ARC_STD_FRACTION
from cell.study.imports.arc_std import ROUNDED_M, arc_length_stds
from cell.study.imports.capture import Capture
from cell.study.imports.choosing import Chosen, choose, seen_places
from cell.study.imports.column_names import is_of_wrench
from cell.study.imports.contents import Contents, Point, contents
from cell.study.imports.convert import times_s
from cell.study.imports.directions import find_axes
from cell.study.imports.finding import Finding, Sure
from cell.study.imports.hand_pose import Root, clamp_angle
from cell.study.imports.hand_section import AxesSection, HandSection
from cell.study.imports.mapping import FORMAT, CableSection, Mapping, MarkerEntry, TrialEntry
from cell.study.imports.scales import metres_per_unit, time_section
from cell.study.imports.sensed_hand import hand_by_sensor
from cell.study.imports.shape import arc_lengths, middle, rest_rows, resting, root_direction
from cell.study.imports.trials import Files, text_section, trial_entries

FloatArray = NDArray[np.float64]

#: A proposed arc length this much longer than the stated cable is its tip.
_TIP = 0.02
#: Points of a chain that show a line and no bend.
_A_LINE = 2


@dataclass(frozen=True)
class Stated:
    """What somebody says of cable and files; None = nothing."""

    name: str
    free_length_m: float | None = None
    line_density_kg_per_m: float | None = None
    width_m: float | None = None
    thickness_m: float | None = None
    diameter_m: float | None = None
    rate_hz: float | None = None


@dataclass(frozen=True)
class Understanding:
    """A mapping that is proposed, and why."""

    mapping: Mapping
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class _Scene:
    """The chain of points in the study's plane.

    xy_m   (rows, points, 2), the gripping point first where it is in the same file
    arcs   (markers,) from the gripping point, m
    shape  (points, 2) at rest
    """

    xy_m: FloatArray
    arcs: FloatArray
    shape: FloatArray


def understand(trials: Sequence[Files], stated: Stated) -> Understanding:
    """Propose a mapping.  Raises InputError: a file has no points or no hand, or is disordered."""
    first = trials[0]
    inside = contents(first.capture)
    elsewhere = first.hand is not None or inside.senses_hand
    others = [files.capture for files in trials[1:]]
    chosen, findings = choose(first.capture, inside, elsewhere, others)
    time, told = time_section(first.capture, inside, stated.rate_hz)
    findings = [*told, *findings]
    times_s(first.capture, time)  # in disorder nothing below means anything
    points = [*([chosen.hand] if chosen.hand else []), *chosen.markers]
    raw = np.stack([seen_places(first.capture, p.columns, chosen.lost) for p in points], axis=1)
    shape = _shape(raw)
    extent = float(np.linalg.norm(np.diff(shape, axis=0), axis=1).sum())
    scale, finding = metres_per_unit({p.unit for p in points}, extent, stated.free_length_m)
    axes, told = find_axes(raw, shape)
    findings += [finding, *told]
    scene = _scene(raw, axes, scale or 1.0, chosen)
    arcs, told = _arcs(scene, chosen, stated, known=scale is not None)
    findings += told
    stds, told = _arc_stds(raw * (scale or 1.0), scene, chosen, stated, arcs)
    findings += told
    hand, told = _hand(first, inside, chosen, axes, scene, scale)
    findings += told
    mapping = Mapping(
        format=FORMAT,
        name=stated.name,
        cable=_cable(stated, arcs),
        text=text_section(first.capture),
        time=time,
        metres_per_unit=scale,
        lost=chosen.lost,
        axes=axes,
        hand=hand,
        markers=[
            MarkerEntry(
                name=p.name, columns=list(p.columns), arc_length_m=arc, arc_length_std_m=std
            )
            for p, arc, std in zip(chosen.markers, arcs, stds, strict=True)
        ],
        trials=[TrialEntry(name=t.name, file=t.file, hand_file=t.hand_file) for t in trials],
    )
    entries, told = trial_entries(trials, mapping, stated.rate_hz)
    findings += [*told, *_wanted(mapping), *_unused(inside, chosen, first.capture)]
    return Understanding(mapping.model_copy(update={"trials": entries}), tuple(findings))


def _shape(raw: FloatArray) -> FloatArray:
    """(points, d) at rest, else a mean of what is seen."""
    rest = resting(raw)
    return middle(raw if rest is None else rest)


def _scene(raw: FloatArray, axes: AxesSection, scale: float, chosen: Chosen) -> _Scene:
    directions = np.array([axes.right, axes.up])
    xy_m = raw @ directions.T * scale
    shape = _shape(xy_m)
    # Of the mean shape at rest: noise lengthens the curve through points of a single row.
    at_rest = len(xy_m[rest_rows(xy_m)]) > 0 and np.isfinite(shape).all()
    lengths = arc_lengths(shape[None] if at_rest else xy_m)
    if chosen.hand is None:  # the first marker is at an unknown distance from the hand
        return _Scene(xy_m, lengths, shape)
    return _Scene(xy_m, lengths[1:], shape)


def _arcs(
    scene: _Scene, chosen: Chosen, stated: Stated, known: bool
) -> tuple[list[float | None], list[Finding]]:
    """Where the markers are along the cable, to 10 µm; None where nothing tells it."""
    if not known:
        sentence = "where the markers are along the cable is known with the unit of length"
        return [None] * len(chosen.markers), [Finding("markers", sentence, Sure.WANTED)]
    lengths, length_m = scene.arcs, stated.free_length_m
    if chosen.hand is None:
        if length_m is None:
            sentence = "where the markers are along the cable needs --free-length"
            return [None] * len(lengths), [Finding("markers", sentence, Sure.WANTED)]
        lengths = lengths + length_m - lengths[-1]
    arcs = [round(float(s), 5) for s in lengths]
    if length_m is not None and 0.0 < arcs[-1] - length_m <= _TIP * length_m:
        arcs[-1] = length_m
    sentence = (
        f"arc lengths are those of a curve through the markers, {arcs[0]:g} … {arcs[-1]:g} m; "
        "measured ones are better"
    )
    findings = [Finding("markers", sentence, Sure.GUESSED)]
    if length_m is not None and arcs[-1] > length_m:
        sentence = (
            f"the markers span {arcs[-1]:g} m from the hand, the cable {length_m:g} m: is the "
        )
        sentence += "hand's place, a unit or --free-length wrong?"
        findings.append(Finding("markers", sentence, Sure.GUESSED))
    if length_m is None:
        sentence = f"the cable ends at its last marker: {arcs[-1]:g} m long; give --free-length"
        findings.append(Finding("cable.free_length_m", sentence, Sure.GUESSED))
    return list(arcs), findings


def _arc_stds(
    places_m: FloatArray,
    scene: _Scene,
    chosen: Chosen,
    stated: Stated,
    arcs: Sequence[float | None],
) -> tuple[list[float | None], list[Finding]]:
    """How well the proposed arc lengths are known; None where none is proposed."""
    last_m = arcs[-1]
    if last_m is None:
        return [None] * len(arcs), []
    length_m, from_hand = stated.free_length_m or last_m, chosen.hand is not None
    stds = arc_length_stds(places_m, length_m, from_hand)
    beyond_m = float(scene.arcs[-1]) - last_m if from_hand else 0.0
    findings = []
    if beyond_m > max(stds[-1], ROUNDED_M):  # a tip is on the cable, though the curve is longer
        stds[-1] = min(
            float(f"{np.hypot(stds[-1], beyond_m):.2g}"), MAX_ARC_STD_FRACTION * length_m
        )
        sentence = (
            f"the curve is {beyond_m * 1e3:.2g} mm longer than the cable: its last marker is "
        )
        findings.append(Finding("markers", f"{sentence}taken as the tip", Sure.GUESSED))
    low, high = (f"{v * 1e3:.2g}" for v in (stds.min(), stds.max()))
    sentence = (
        f"arc_length_std_m, {low if low == high else f'{low} … {high}'} mm, is what noise and the "
        "bend between markers leave open; give your own where you measure"
    )
    return stds.tolist(), [*findings, Finding("markers", sentence, Sure.GUESSED)]


def _cable(stated: Stated, arcs: Sequence[float | None]) -> CableSection:
    return CableSection(
        free_length_m=stated.free_length_m or arcs[-1],
        line_density_kg_per_m=stated.line_density_kg_per_m,
        width_m=stated.width_m,
        thickness_m=stated.thickness_m,
        diameter_m=stated.diameter_m,
    )


def _hand(
    first: Files,
    inside: Contents,
    chosen: Chosen,
    axes: AxesSection,
    scene: _Scene,
    scale: float | None,
) -> tuple[HandSection, list[Finding]]:
    """The gripping point and the clamp angle, from the same file or another one."""
    if first.hand is not None:
        return _hand_elsewhere(first.hand, axes, scene, scale)
    if inside.senses_hand:
        return hand_by_sensor(first.capture, inside, axes, _root_at_rest(scene), {})
    hand = chosen.hand
    assert hand is not None
    root = _root(scene)
    second = None
    if chosen.second is not None:
        rest = _shape(
            np.stack(
                [seen_places(first.capture, p.columns, chosen.lost) for p in (hand, chosen.second)],
                axis=1,
            )
        )
        line = np.array([axes.right, axes.up]) @ (rest[1] - rest[0])
        second = chosen.second, _angle_of(line)
    angle, findings = clamp_angle(first.capture, inside, axes, root, second, hand.name)
    return HandSection(columns=list(hand.columns), angle=angle), findings


def _hand_elsewhere(
    capture: Capture, axes: AxesSection, scene: _Scene, scale: float | None
) -> tuple[HandSection, list[Finding]]:
    inside = contents(capture)
    root = _root_at_rest(scene)
    time, told = time_section(capture, inside, None)
    of_file: dict[str, Any] = {"text": text_section(capture), "time": time}
    named = [p for p in inside.points if p.of_hand] or list(inside.points)
    if not named and inside.senses_hand:
        section, findings = hand_by_sensor(capture, inside, axes, root, of_file)
        return section, [*told, *findings]
    if not named:
        message = (
            "has no x and y of the hand; name two columns as hand_x and hand_y, that of its axle's "
            "encoder as encoder, or those of an accelerometer on it as acc_x and acc_y. Columns: "
        )
        raise capture.error(0, f"{message}{', '.join(capture.names[:12])}")
    hand: Point = named[0]
    findings = [
        Finding("hand", f"{hand.name!r} of {capture.path.name} is the gripping point", Sure.GUESSED)
    ]
    same = len(hand.columns) == len(axes.up)
    own = None if same else AxesSection(right=[1.0, 0.0], up=[0.0, 1.0])
    if not same:
        sentence = "the hand's file has its own axes: right and up are its first and second"
        findings.append(Finding("hand.axes", sentence, Sure.GUESSED))
    at = seen_places(capture, hand.columns, ())
    extent = float(np.nanmax(np.abs(at)))
    unit, finding = metres_per_unit({hand.unit}, extent, None) if hand.unit else (scale, None)
    findings += [*told, *([finding] if finding else [])]
    angle, told = clamp_angle(capture, inside, axes, root, None, hand.name)
    section = HandSection(
        columns=list(hand.columns),
        angle=angle,
        metres_per_unit=unit,
        axes=own,
        **of_file,
    )
    return section, [*findings, *told]


def _root_at_rest(scene: _Scene) -> Root:
    """The clamp angle as the markers show it at rest, where they have no rows in common with it."""
    shape = scene.shape
    angle = _angle_of(root_direction(shape)) if len(shape) > 1 else 0.0
    return Root(np.full(1, np.nan), angle, len(shape) <= _A_LINE)


def _root(scene: _Scene) -> Root:
    """The clamp angle as the cable's root shows it, row by row and at rest."""
    angle = np.full(len(scene.xy_m), np.nan)
    whole = np.isfinite(scene.xy_m).all(axis=(1, 2))
    directions = [root_direction(shape) for shape in scene.xy_m[whole]]
    angle[whole] = np.unwrap([_angle_of(d) for d in directions])
    return Root(angle, _angle_of(root_direction(scene.shape)), len(scene.shape) <= _A_LINE)


def _angle_of(direction: FloatArray) -> float:
    """Clamp angle of a direction in which a cable leaves."""
    return float(np.arctan2(-direction[1], -direction[0]))


def _wanted(mapping: Mapping) -> list[Finding]:
    """What a file of places cannot tell of a cable."""
    found = []
    if mapping.cable.line_density_kg_per_m is None:
        sentence = "give cable.line_density_kg_per_m: the mass of a piece divided by its length"
        found.append(Finding("cable.line_density_kg_per_m", sentence, Sure.WANTED))
    across = mapping.cable.width_m is None or mapping.cable.thickness_m is None
    if across and mapping.cable.diameter_m is None:
        sentence = "give cable.width_m and thickness_m of a flat cable, diameter_m of a round one"
        found.append(Finding("cable", sentence, Sure.WANTED))
    return found


def _unused(inside: Contents, chosen: Chosen, capture: Capture) -> list[Finding]:
    """Columns that nothing is made of."""
    used = {n for p in chosen.markers for n in p.columns}
    points = [*([chosen.hand] if chosen.hand else []), *([chosen.second] if chosen.second else [])]
    used |= {n for p in points for n in p.columns}
    rest = [n for p in inside.points for n in p.columns if n not in used] + list(inside.unused)
    if not rest:
        return []
    more = f" and {len(rest) - 8} more" if len(rest) > 8 else ""
    sentence = f"not used of {capture.path.name}: columns {', '.join(rest[:8])}{more}"
    if any(is_of_wrench(name) for name in rest):
        sentence += "; a wrench at the clamp is named as wrench: {columns: [Fx, Fy, Mz]}"
    return [Finding("unused", sentence, Sure.SEEN)]
