"""Mapping proposed from the first of several like files, with findings and how certain they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.arrays import FloatArray
from cell.study.entries import MAX_ARC_STD_FRACTION
from cell.study.imports.capture import Capture, Finding, Sure
from cell.study.imports.choosing import Chosen, choose, detected_places
from cell.study.imports.clamp_angle import Root, clamp_angle
from cell.study.imports.column_names import is_of_wrench
from cell.study.imports.contents import Contents, Point, contents
from cell.study.imports.convert import times_s
from cell.study.imports.directions import find_axes
from cell.study.imports.gripper_proposal import (
    TIP,
    GripperFile,
    NearestMarker,
    first_point,
    gripper_file,
    reach,
    section_of_file,
    sensor_section,
)
from cell.study.imports.gripper_section import (
    AngleSection,
    AxesSection,
    GripperSection,
    TextSection,
)
from cell.study.imports.mapping import FORMAT, CableSection, Mapping, MarkerEntry, TrialEntry
from cell.study.imports.places import angle_of, places_m
from cell.study.imports.scales import ROUNDED_M, arc_length_stds, metres_per_unit, time_section
from cell.study.imports.shape import arc_lengths, middle, rest_rows, resting, root_direction
from cell.study.imports.trials import Files, trial_entries

#: Rows of a long trial in which the direction of the cable's root is estimated.
_ROOTS = 1000
#: Points of a chain that show a line and no bend, and that show how a curve goes on.
_A_LINE, _A_CURVE = 2, 3
#: Where the curve through the markers begins is known to so much of the cable's length.
_SAME_FRAME = 0.05


@dataclass(frozen=True)
class Stated:
    """What the user states about cable and files; None = not stated."""

    name: str
    free_length_m: float | None = None
    line_density_kg_per_m: float | None = None
    width_m: float | None = None
    thickness_m: float | None = None
    diameter_m: float | None = None
    rate_hz: float | None = None


@dataclass(frozen=True)
class Understanding:
    """A proposed mapping, with findings that explain it."""

    mapping: Mapping
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class _Scene:
    """The chain of points in the study's plane.

    xy_m          (rows, points, 2), the gripping point first where it is in the same file
    arcs          (markers,) from the gripping point, m
    shape         (points, 2) at rest, the gripping point first where that is known
    from_gripper  whether it is; else arcs are from the first marker
    """

    xy_m: FloatArray
    arcs: FloatArray
    shape: FloatArray
    from_gripper: bool


def understand(trials: Sequence[Files], stated: Stated) -> Understanding:
    """Propose a mapping.  Raises InputError: a file has no points or no gripper, or is
    disordered."""
    first = trials[0]
    inside = contents(first.capture)
    apart = None if first.gripper is None else gripper_file(first.gripper)
    elsewhere = apart is not None or inside.has_gripper_sensor
    others = [files.capture for files in trials[1:]]
    chosen, findings = choose(first.capture, inside, elsewhere, others)
    time, told = time_section(first.capture, inside, stated.rate_hz)
    findings = [*told, *findings]
    times_s(first.capture, time)  # in disorder nothing below means anything
    points = [*([chosen.gripper] if chosen.gripper else []), *chosen.markers]
    raw = _detected(first.capture, points, chosen)
    shape, units = _shape(raw), {p.unit for p in points}
    begins = None
    if apart is not None and len(raw[rest_rows(raw)]):
        begins = first_point(apart, shape, units, stated.free_length_m)
    shape = shape if begins is None else np.vstack([begins, shape])
    extent = float(np.linalg.norm(np.diff(shape, axis=0), axis=1).sum())
    scale, finding = metres_per_unit(units, extent, stated.free_length_m)
    axes, told = find_axes(raw, shape)
    findings += [finding, *told]
    scene = _scene(raw, axes, scale or 1.0, begins, chosen.gripper is not None)
    arcs, told = _arcs(scene, chosen, stated, known=scale is not None)
    findings += told
    chain_m = _chain(raw, begins if scene.from_gripper else None) * (scale or 1.0)
    stds, told = _arc_stds(chain_m, scene, chosen, stated, arcs)
    findings += told
    nearest = None
    if apart is not None and apart.point is not None and scale is not None:
        nearest = _nearest(trials, apart.point, chosen, axes, scale)
    hand, told = _gripper(first, apart, inside, chosen, axes, scene, scale, nearest)
    findings += told
    if apart is not None and begins is None:
        hand, told = _with_origin(hand, apart, axes, scene, arcs, scale)
        findings += told
    mapping = Mapping(
        format=FORMAT,
        name=stated.name,
        cable=_cable(stated, arcs),
        text=TextSection.of(first.capture),
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
        trials=[TrialEntry(name=t.name, file=t.file, hand_file=t.gripper_file) for t in trials],
    )
    entries, told = trial_entries(trials, mapping, stated.rate_hz)
    findings += [*told, *_missing_entries(mapping), *_unused(inside, chosen, hand, first.capture)]
    return Understanding(mapping.model_copy(update={"trials": entries}), tuple(findings))


def _detected(capture: Capture, points: Sequence[Point], chosen: Chosen) -> FloatArray:
    """(rows, points, d) where points are seen, in the file's unit and axes."""
    of_hand = (chosen.gripper, chosen.second)
    return np.stack(
        [detected_places(capture, p.columns, chosen.lost, of_hand=p in of_hand) for p in points],
        axis=1,
    )


def _chain(raw: FloatArray, begins: FloatArray | None) -> FloatArray:
    """Places (rows, points, d), behind that (d,) where the gripper of another file rests, if
    known."""
    if begins is None:
        return raw
    return np.concatenate([np.broadcast_to(begins, (len(raw), 1, len(begins))), raw], axis=1)


def _shape(raw: FloatArray) -> FloatArray:
    """(points, d) at rest, else a mean of what is seen."""
    rest = resting(raw)
    return middle(raw if rest is None else rest)


def _scene(
    raw: FloatArray, axes: AxesSection, scale: float, begins: FloatArray | None, with_hand: bool
) -> _Scene:
    """The chain in the plane.

    begins     (d,) where the gripper of another file rests; None = that is not known
    with_hand  the first of the points is the gripping point
    """
    directions = np.array([axes.right, axes.up])
    xy_m = raw @ directions.T * scale
    shape = _shape(xy_m)
    if begins is not None:
        shape = np.vstack([directions @ begins * scale, shape])
    # Of the mean shape at rest: noise lengthens the curve through points of a single row.
    at_rest = resting(xy_m) is not None and np.isfinite(shape).all()
    lengths = arc_lengths(shape[None] if at_rest or begins is not None else xy_m)
    if begins is not None and len(shape) <= _A_LINE:
        lengths = lengths[1:]  # nothing shows how far a cable droops from the line to one marker
    from_hand = with_hand or (begins is not None and len(shape) > _A_LINE)
    # Else the first marker is at an unknown distance from the gripper.
    return _Scene(xy_m, lengths[1:] if from_hand else lengths, shape, from_hand)


def _arcs(
    scene: _Scene, chosen: Chosen, stated: Stated, known: bool
) -> tuple[list[float | None], list[Finding]]:
    """Where the markers are along the cable, to 10 µm; None where nothing tells it."""
    if not known:
        sentence = "where the markers are along the cable is known with the unit of length"
        return [None] * len(chosen.markers), [Finding("markers", sentence, Sure.WANTED)]
    lengths, length_m = scene.arcs, stated.free_length_m
    how = "" if chosen.gripper is not None else ", from the gripper's place at rest on"
    if not scene.from_gripper:
        if length_m is None:
            sentence = "where the markers are along the cable needs --free-length"
            return [None] * len(lengths), [Finding("markers", sentence, Sure.WANTED)]
        lengths = lengths + length_m - lengths[-1]
        why = "no place of the gripper at rest is known in their frame"
        if len(scene.shape) > scene.xy_m.shape[1]:
            why = "one marker shows no curve from the gripper on"
        how = f", {chosen.markers[-1].name!r} taken as the cable's tip, for {why}"
    arcs = [round(float(s), 5) for s in lengths]
    if length_m is not None and 0.0 < arcs[-1] - length_m <= TIP * length_m:
        arcs[-1] = length_m
    sentence = (
        f"arc lengths are those of a curve through the markers, {arcs[0]:g} … {arcs[-1]:g} m{how}; "
        "measured ones are better"
    )
    findings = [Finding("markers", sentence, Sure.GUESSED)]
    if length_m is not None and arcs[-1] > length_m:
        sentence = (
            f"the markers span {arcs[-1]:g} m from the gripper, the cable {length_m:g} m: is the "
        )
        sentence += "gripper's place, a unit or --free-length wrong?"
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
    """How well the proposed arc lengths are known; None where none is proposed, or nothing tells.

    places_m  (rows, points, d) of the chain, from the gripper on where that is known
    """
    last_m = arcs[-1]
    if last_m is None or places_m.shape[1] < _A_LINE:
        return [None] * len(arcs), []
    length_m = stated.free_length_m or last_m
    stds = arc_length_stds(places_m, length_m, scene.from_gripper)
    beyond_m = float(scene.arcs[-1]) - last_m if scene.from_gripper else 0.0
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


def _gripper(
    first: Files,
    elsewhere: GripperFile | None,
    inside: Contents,
    chosen: Chosen,
    axes: AxesSection,
    scene: _Scene,
    scale: float | None,
    nearest: NearestMarker | None,
) -> tuple[GripperSection, list[Finding]]:
    """The gripping point and the clamp angle, from the same file or another one."""
    if elsewhere is not None:
        return section_of_file(elsewhere, axes, _root_at_rest(scene), scale, nearest)
    if inside.has_gripper_sensor:
        return sensor_section(first.capture, inside, axes, _root_at_rest(scene), {})
    hand = chosen.gripper
    if hand is None:
        return GripperSection(angle=AngleSection()), []
    root = _root(scene)
    second = None
    if chosen.second is not None:
        rest = _shape(_detected(first.capture, (hand, chosen.second), chosen))
        line = np.array([axes.right, axes.up]) @ (rest[1] - rest[0])
        second = chosen.second, angle_of(line)
    angle, findings = clamp_angle(first.capture, inside, axes, root, second, hand.name)
    return GripperSection(columns=list(hand.columns), angle=angle), findings


def _nearest(
    trials: Sequence[Files], point: Point, chosen: Chosen, axes: AxesSection, scale: float
) -> NearestMarker | None:
    """Motion of the marker next to the gripper where that moves most; None = no trial tells it.

    point  the gripping point, in files of their own
    """
    marker, best = chosen.markers[0], None
    for files in trials:
        there = files.gripper is not None and set(point.columns) <= set(files.gripper.names)
        if not there or not set(marker.columns) <= set(files.capture.names):
            continue
        assert files.gripper is not None
        hand = detected_places(files.gripper, point.columns, ())
        xy_m = places_m(files.capture, marker.columns, axes, scale, chosen.lost)
        if best is None or reach(hand) > reach(best.hand):
            best = NearestMarker(hand, xy_m)
    return best


def _with_origin(
    hand: GripperSection,
    apart: GripperFile,
    axes: AxesSection,
    scene: _Scene,
    arcs: Sequence[float | None],
    scale: float | None,
) -> tuple[GripperSection, list[Finding]]:
    """The section with the origin of the gripper's places, where that is not the markers'.

    At rest the curve through the markers goes on to the gripping point.
    """
    known = [a for a in arcs if a is not None]
    unknown = hand.columns is None or apart.initial is None or scale is None
    if unknown or len(known) < _A_CURVE or len(known) != len(scene.shape):
        return hand, []
    begins_m = CubicSpline(known, scene.shape)(0.0)
    own, unit = hand.axes or axes, hand.metres_per_unit or scale or 1.0
    assert apart.initial is not None
    hand_m = np.array([own.right, own.up]) @ apart.initial * unit
    origin_m = begins_m - hand_m
    if float(np.hypot(*origin_m)) < _SAME_FRAME * known[-1]:
        return hand, []
    x_m, y_m = (round(float(v), 5) for v in origin_m)
    sentence = (
        f"the gripper's places have another origin: [{x_m:g}, {y_m:g}] m are added, so that the "
        "curve through the markers at rest begins at the gripper; measure hand.origin_m"
    )
    return hand.model_copy(update={"origin_m": (x_m, y_m)}), [
        Finding("hand.origin_m", sentence, Sure.GUESSED)
    ]


def _root_at_rest(scene: _Scene) -> Root:
    """The clamp angle as the markers show it at rest, where they have no rows in common with it."""
    shape = scene.shape
    angle = angle_of(root_direction(shape)) if len(shape) > 1 else 0.0
    return Root(np.full(1, np.nan), angle, len(shape) <= _A_LINE)


def _root(scene: _Scene) -> Root:
    """The clamp angle as the cable's root shows it, in rows all over the trial and at rest."""
    angle = np.full(len(scene.xy_m), np.nan)
    whole = np.flatnonzero(np.isfinite(scene.xy_m).all(axis=(1, 2)))
    whole = whole[:: max(1, len(whole) // _ROOTS)]
    directions = [root_direction(shape) for shape in scene.xy_m[whole]]
    angle[whole] = np.unwrap([angle_of(d) for d in directions])
    return Root(angle, angle_of(root_direction(scene.shape)), len(scene.shape) <= _A_LINE)


def _missing_entries(mapping: Mapping) -> list[Finding]:
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


def _unused(
    inside: Contents, chosen: Chosen, hand: GripperSection, capture: Capture
) -> list[Finding]:
    """Columns that nothing is made of."""
    used = {n for p in chosen.markers for n in p.columns}
    points = [
        *([chosen.gripper] if chosen.gripper else []),
        *([chosen.second] if chosen.second else []),
    ]
    used |= {n for p in points for n in p.columns}
    rest = [n for p in inside.points for n in p.columns if n not in used] + list(inside.unused)
    rest += [n for n, _ in inside.angles if n != hand.angle.column]
    if not rest:
        return []
    more = f" and {len(rest) - 8} more" if len(rest) > 8 else ""
    sentence = f"not used of {capture.path.name}: columns {', '.join(rest[:8])}{more}"
    if any(is_of_wrench(name) for name in rest):
        sentence += "; a wrench at the clamp is named as wrench: {columns: [Fx, Fy, Mz]}"
    return [Finding("unused", sentence, Sure.SEEN)]
