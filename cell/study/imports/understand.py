"""Mapping proposed from the first of several like files, with findings and how certain they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.words import first_of
from cell.study.entries import CableSection
from cell.study.imports.cable_root import Root, curve_to_gripper, start_of
from cell.study.imports.capture import Capture, Finding, ImportFindings, Sure
from cell.study.imports.choosing import Chosen, check_scales, choose, detected_places
from cell.study.imports.clamp_angle import clamp_angle, stated_angle
from cell.study.imports.column_names import ColumnKind, Meaning, is_of_wrench
from cell.study.imports.contents import Contents, Point, contents, on_one_clock
from cell.study.imports.gripper_proposal import (
    TIP,
    GripperFile,
    NearestMarker,
    displacement,
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
)
from cell.study.imports.mapping import FORMAT, Mapping, MarkerEntry, TrialEntry
from cell.study.imports.places import angle_of, find_axes, places_m
from cell.study.imports.plane_chain import (
    MeasuredArcs,
    PlaneChain,
    arc_stds,
    arcs_of,
    detected_points,
    measured_arcs,
    root_at_rest,
    root_ends,
    root_in_rows,
    scene_of,
    shape_at_rest,
    shapes_of,
)
from cell.study.imports.scales import (
    metres_per_unit,
    time_of_markers,
    times_s,
)
from cell.study.imports.shape import arc_lengths, rest_rows
from cell.study.imports.stated import OF_CABLE, Stated, with_files
from cell.study.imports.trial_files import by_rows, named_alike
from cell.study.imports.trials import Files, origin_by_clamp, stroke_gain, trial_entries
from cell.study.imports.units import METRES
from cell.study.series import noise_m

#: Minimum downward component of a second coordinate that runs down, as in an image.
_DOWN = 0.5
#: Maximum distance of a marker at the gripping point, as a fraction of the cable's length.
_AT_GRIPPER = 0.005
#: Minimum share in the plane of the line between two points that show the clamp angle, and maximum
#: ratio of its noise to its length.
_ACROSS = 0.2
#: Tolerance of the start of the curve through the markers, as a fraction of the cable's length.
_SAME_FRAME = 0.05
#: Maximum number of scales tried, as the root depends on them; tolerance of the last, and of a unit
#: that has a name.
_MOST_SCALES, _SAME_GAIN, _NAMED_UNIT = 6, 2e-3, 0.1


@dataclass(frozen=True)
class Understanding:
    """A proposed mapping, with findings that explain it."""

    mapping: Mapping
    findings: tuple[Finding, ...]


def understand(trials: Sequence[Files], stated: Stated) -> Understanding:
    """Propose a mapping.  Raises InputError: a file has no points or no gripper, or is
    disordered.

    Where the markers' unit is not stated, the gripper's stroke in its own file fixes it.
    """
    proposed, gain = _proposed(trials, stated, None)
    first, unit = proposed, proposed.mapping.metres_per_unit
    named = any(f.entry == "metres_per_unit" and f.sure is Sure.SHOWN for f in first.findings)
    if gain is None or unit is None or (named and abs(gain - 1.0) < _NAMED_UNIT):
        return first
    for _ in range(_MOST_SCALES):
        unit /= gain
        proposed, gain = _proposed(trials, stated, unit)
        arc_m = proposed.mapping.markers[0].arc_length_m
        if gain is None or arc_m is None or arc_m < -TIP * (stated.free_length_m or 0.0):
            break
        if abs(gain - 1.0) < _SAME_GAIN:
            return proposed
    sentence = f"by the gripper's stroke a unit is {unit:.4g} m, for which the free length is wrong"
    against = Finding("metres_per_unit", sentence, Sure.GUESSED)
    return replace(first, findings=(*first.findings, against))


def _proposed(
    trials: Sequence[Files], stated: Stated, by_stroke: float | None
) -> tuple[Understanding, float | None]:
    """A proposal, and the motion of the root over the gripper's; None = unit stated, or unknown.

    by_stroke  metres a unit of the markers; None = by what the file states or the free length
    """
    findings = ImportFindings()
    trials = named_alike(by_rows(trials, findings), findings)
    first = trials[0]
    inside = contents(first.capture)
    gripper = None if first.gripper is None else gripper_file(first.gripper)
    inside, gripper = _on_one_clock(inside, first.capture, gripper)
    elsewhere = gripper is not None or inside.has_gripper_sensor
    captures = [files.capture for files in trials[1:]]
    stated = with_files(stated, [files.capture for files in trials], findings)
    _add_joined(first, findings)
    chosen = choose(first.capture, inside, elsewhere, findings, captures, stated.free_length_m)
    check_scales([files.capture for files in trials], chosen, findings)
    time, finding = time_of_markers(
        first.capture, inside, chosen.gripper, chosen.markers, stated.rate_hz
    )
    findings.insert(0, finding)
    times_s(first.capture, time)  # raises if its rows are in disorder
    start = chosen.gripper or _clamp(first.capture, chosen, gripper, stated, findings)
    points = [*([start] if start else []), *chosen.markers]
    raw = detected_points(first.capture, points, chosen)
    shape, units, rest = shape_at_rest(raw), {p.unit for p in points}, None
    if gripper is not None and start is None and len(raw[rest_rows(raw)]):
        rest = first_point(gripper, shape, units, stated.free_length_m)
    shape = shape if rest is None else np.vstack([rest, shape])
    extent = float(np.linalg.norm(np.diff(shape, axis=0), axis=1).sum())
    scale, finding = metres_per_unit(units, extent, stated.free_length_m, by_stroke)
    is_stated = by_stroke is None and finding.sure not in (Sure.SHOWN, Sure.GUESSED)
    axes, of_axes = find_axes(raw, shape, shapes_of(trials[1:], points, chosen))
    findings += [_of_image(finding, axes, raw), *of_axes]
    scene = scene_of(raw, axes, scale or 1.0, rest, start is not None)
    measured = measured_arcs(first.capture, chosen.markers, stated, scene, scale is not None)
    arcs = arcs_of(scene, chosen, stated, scale is not None, measured, findings)
    stds = arc_stds(scene, stated, arcs, measured, findings)
    at_ends, *others = root_ends(trials, points, chosen, axes, arcs)
    root = replace(root_at_rest(scene, arcs), first=at_ends, others=tuple(filter(None, others)))
    if gripper is not None:
        is_timed = time.seconds_per_unit is not None
        lasts_s = float(np.ptp(times_s(first.capture, time))) if is_timed else None
        nearest = _nearest(trials, gripper.point, chosen, axes, scale)
        hand = section_of_file(gripper, axes, root, scale, nearest, lasts_s, findings)
    else:
        hand = _gripper(first.capture, chosen, axes, scene, root, findings)
    if gripper is not None and rest is None and start is None:
        hand = _with_origin(hand, gripper, axes, scene, arcs, scale, findings)
    sources = [files.gripper or files.capture for files in trials]
    hand = stated_angle(sources, hand, axes, stated.clamp_angle_rad, root, findings)
    mapping = Mapping(
        format=FORMAT,
        name=stated.name,
        cable=_cable(stated, arcs),
        text=first.capture.form,
        time=time,
        metres_per_unit=scale,
        lost=chosen.lost,
        axes=axes,
        hand=hand,
        markers=[
            MarkerEntry(name=p.name, columns=list(p.columns), arc_length_m=a, arc_length_std_m=std)
            for p, a, std in zip(chosen.markers, arcs, stds, strict=True)
        ],
        trials=[_trial(t) for t in trials],
    )
    if start is not None and (origin_m := origin_by_clamp(first, mapping, start)) is not None:
        least_m = _AT_GRIPPER * (mapping.cable.free_length_m or 0.0)
        hand = _moved(hand, origin_m, least_m, f"they are those of {start.name!r}", findings)
        mapping = mapping.model_copy(update={"hand": hand})
    entries = trial_entries(trials, mapping, stated.rate_hz, findings, chosen.clamp)
    gain = None if is_stated else stroke_gain(trials, mapping, chosen.clamp)
    markers = _from_gripper(mapping.markers)
    _add_missing(mapping, findings)
    _add_unused((inside, first.capture), chosen, gripper, hand, measured, findings)
    mapping = mapping.model_copy(update={"trials": entries, "markers": markers})
    return Understanding(mapping, tuple(findings)), gain


def _on_one_clock(
    inside: Contents, capture: Capture, gripper: GripperFile | None
) -> tuple[Contents, GripperFile | None]:
    """Contents of the markers' file and of the gripper's, by times since 1970 if one needs it."""
    if gripper is None:
        return inside, None
    both = (inside, capture), (gripper.inside, gripper.capture)
    own = replace(gripper, inside=on_one_clock(*both[1], *both[0]))
    return on_one_clock(*both[0], *both[1]), own


def _add_joined(files: Files, findings: ImportFindings) -> None:
    if files.joined_files:
        joined = first_of([Path(name).name for name in files.joined_files], 8)
        sentence = f"{Path(files.file).name} and {joined} are of one recording: "
        findings.guessed("trials", f"{sentence}they are taken as one motion's")


def _trial(files: Files) -> TrialEntry:
    return TrialEntry(
        name=files.name,
        file=files.file,
        joined_files=files.joined_files,
        hand_file=files.gripper_file,
        only=dict(files.only),
    )


def _of_image(finding: Finding, axes: AxesSection, raw: FloatArray) -> Finding:
    """The finding about an unstated unit, where the second coordinate runs down as in an image.

    raw  (rows, points, d) places in the file's unit
    """
    if finding.sure not in (Sure.SHOWN, Sure.GUESSED) or not axes.up[1] < -_DOWN:
        return finding
    if np.nanmin(raw) >= 0.0 and np.nanmax(raw) <= 1.0:
        unit = "shares of an image's size, multiply x by its width and y by its height in pixels"
    elif finding.sure is Sure.SHOWN:
        unit = "pixels, give metres_per_unit"
    else:
        return finding
    return replace(finding, sentence=f"{finding.sentence}; if these are {unit}", sure=Sure.GUESSED)


def _from_gripper(markers: list[MarkerEntry]) -> list[MarkerEntry]:
    """Markers; a first arc length that is slightly negative becomes 0."""
    first, last = markers[0].arc_length_m, markers[-1].arc_length_m
    if first is None or last is None or not -_AT_GRIPPER * last <= first < 0.0:
        return markers
    return [markers[0].model_copy(update={"arc_length_m": 0.0}), *markers[1:]]


def _cable(stated: Stated, arcs: Sequence[float | None]) -> CableSection:
    known = {name: getattr(stated, name) for name in OF_CABLE}
    return CableSection(**known | {"free_length_m": stated.free_length_m or arcs[-1]})


def _gripper(
    capture: Capture,
    chosen: Chosen,
    axes: AxesSection,
    scene: PlaneChain,
    root: Root,
    findings: ImportFindings,
) -> GripperSection:
    """The gripping point and the clamp angle, from the file of the markers."""
    inside, hand = contents(capture), chosen.gripper
    if inside.has_gripper_sensor:
        return sensor_section(capture, inside, axes, root, {}, findings)
    if hand is None:
        return GripperSection(angle=AngleSection())
    named = inside.point(hand.name)
    spare = () if named is None else named.columns[len(hand.columns) :]  # perhaps its angle
    angles = tuple((n, Meaning(ColumnKind.ANGLE, hand.name, "", "")) for n in spare)
    inside = replace(inside, angles=inside.angles + angles)
    second = None
    if chosen.second is not None:
        line = _line(detected_points(capture, (hand, chosen.second), chosen), axes)
        if line is not None:
            second = chosen.second, angle_of(line)
    root = replace(root, angle_rad=root_in_rows(scene))
    angle = clamp_angle(capture, inside, axes, root, findings, hand.name, second)
    return GripperSection(columns=list(hand.columns), angle=angle)


def _line(both: FloatArray, axes: AxesSection) -> FloatArray | None:
    """(2,) line in the plane between two points at rest; None = too short, or for its noise.

    both  (rows, 2, d) positions of points of one body: the distance varies by their noise
    """
    rest = shape_at_rest(both)
    line = np.array([axes.right, axes.up]) @ (rest[1] - rest[0])
    distance = np.linalg.norm(both[:, 1] - both[:, 0], axis=1)
    distance = distance[np.isfinite(distance)]
    noise = np.median(np.abs(distance - np.median(distance))) if len(distance) else np.inf
    least = max(_ACROSS * np.linalg.norm(rest[1] - rest[0]), noise / _ACROSS)
    return line if np.linalg.norm(line) > least else None


def _nearest(
    trials: Sequence[Files],
    point: Point | None,
    chosen: Chosen,
    axes: AxesSection,
    scale: float | None,
) -> NearestMarker:
    """Motion of the marker next to the gripper where that moves most; empty = no trial has both.

    point  the gripping point, in files of their own
    """
    marker, paths = chosen.clamp or chosen.markers[0], []
    for files in trials:
        if (
            (point is not None and scale is not None and files.gripper is not None)
            and set(point.columns) <= set(files.gripper.names)
            and set(marker.columns) <= set(files.capture.names)
        ):
            hand = detected_places(files.gripper, point.columns, ())
            xy_m = places_m(files.capture, marker.columns, axes, scale, chosen.lost)
            paths.append((hand, xy_m))
    none = np.empty((0, len(axes.up))), np.empty((0, 2))
    most = max(paths, key=lambda path: reach(path[0]), default=none)
    moves = tuple((displacement(hand), displacement(xy_m)) for hand, xy_m in paths)
    return NearestMarker(*most, moves)


def _clamp(
    capture: Capture,
    chosen: Chosen,
    gripper: GripperFile | None,
    stated: Stated,
    findings: ImportFindings,
) -> Point | None:
    """The point of the markers' file that is the gripping point of another file; None = none is.

    From it to the tip the chain is no longer than the cable.
    """
    clamp = chosen.clamp
    if clamp is None or gripper is None or gripper.point is None:
        return None
    sentence = f"{clamp.name!r} of {capture.path.name} is on the gripper: it shows the clock of "
    findings.shown("hand", f"{sentence}{gripper.capture.path.name}")
    shape = shape_at_rest(detected_points(capture, (clamp, *chosen.markers), chosen))
    chain_m = METRES.get(clamp.unit, 0.0) * float(arc_lengths(shape[None])[-1])
    longest_m = (1.0 + TIP) * (stated.free_length_m or np.inf)
    return None if chain_m > longest_m else clamp


def _with_origin(
    hand: GripperSection,
    gripper: GripperFile,
    axes: AxesSection,
    scene: PlaneChain,
    arcs: Sequence[float | None],
    scale: float | None,
    findings: ImportFindings,
) -> GripperSection:
    """The section with the origin of the gripper's positions, if it differs from the markers'.

    At rest the curve through the markers is extrapolated to the gripping point.
    """
    curve = curve_to_gripper(scene.shape, arcs, scene.from_gripper)
    if hand.columns is None or gripper.initial is None or scale is None or curve is None:
        return hand
    (start_m, error_m), length_m = start_of(curve), float(curve.x[-1])
    error_m = float(np.hypot(error_m, np.nan_to_num(noise_m(scene.xy_m[:, 0]))))
    own_axes, unit = hand.axes or axes, hand.metres_per_unit or scale
    initial = np.zeros(len(hand.columns))
    initial[[column is not None for column in hand.columns]] = gripper.initial
    hand_m = np.array([own_axes.right, own_axes.up]) @ initial * unit
    why = "the curve through the markers at rest begins at the gripper, "
    why += f"± {error_m * 1e3:.1g} mm; measure hand.origin_m"
    return _moved(hand, start_m - hand_m, _SAME_FRAME * length_m, why, findings)


def _moved(
    hand: GripperSection, origin_m: FloatArray, least_m: float, why: str, findings: ImportFindings
) -> GripperSection:
    """The section with an origin (2,) of the gripper's positions, if it is that far away."""
    if float(np.hypot(*origin_m)) < least_m:
        return hand
    x_m, y_m = (round(float(v), 5) for v in origin_m)
    sentence = f"the gripper's places have another origin: [{x_m:g}, {y_m:g}] m are added, so that "
    findings.guessed("hand.origin_m", sentence + why)
    return hand.model_copy(update={"origin_m": (x_m, y_m)})


def _add_missing(mapping: Mapping, findings: ImportFindings) -> None:
    cable = mapping.cable
    if cable.line_density_kg_per_m is None:
        sentence = "give cable.line_density_kg_per_m, or --line-density: the mass of a piece "
        findings.missing("cable.line_density_kg_per_m", f"{sentence}divided by its length")
    if cable.diameter_m is None and None in (cable.width_m, cable.thickness_m):
        sentence = "give cable.width_m and thickness_m of a flat cable, diameter_m of a round one, "
        findings.missing("cable", f"{sentence}or --width and --thickness, or --diameter")


def _add_unused(
    file: tuple[Contents, Capture],
    chosen: Chosen,
    gripper: GripperFile | None,
    hand: GripperSection,
    measured: MeasuredArcs | None,
    findings: ImportFindings,
) -> None:
    _add_unused_of_gripper(gripper, hand, findings)
    inside, capture = file
    points = (*chosen.markers, chosen.gripper, chosen.clamp)
    used = {n for p in points if p is not None for n in p.columns} | set(hand.angle.towards or ())
    used |= set(measured.columns if measured is not None else ())
    unused = [*(n for p in inside.points for n in p.columns), *inside.unused]
    unused = [n for n in unused if n not in used]
    of_angle = {hand.angle.column, *(hand.angle.rotation or ())}
    unused += [n for n, _ in inside.angles if n not in of_angle]
    if not unused:
        return
    sentence = f"not used of {capture.path.name}: columns {first_of(unused, 8)}"
    if any(is_of_wrench(name) for name in unused):
        sentence += "; a wrench at the clamp is named as wrench: {columns: [Fx, Fy, Mz]}"
    findings.shown("unused", sentence)


def _add_unused_of_gripper(
    gripper: GripperFile | None, hand: GripperSection, findings: ImportFindings
) -> None:
    """List the angles of the gripper's file that change, but are not used.

    Those from which a robot's quaternion was made are used.
    """
    if gripper is None:
        return
    capture, of_angle, inside = gripper.capture, hand.angle, gripper.inside
    if of_angle.quaternion and capture.are_computed(of_angle.quaternion):
        return
    used = {of_angle.column, *(of_angle.rotation or ()), *(of_angle.quaternion or ())}
    names = [n for n, _ in inside.angles] + [n for _, four in inside.quaternions for n in four]
    unused = [n for n in names if n not in used and np.nanstd(capture.column(n)) > 0.0]
    if unused:
        listed = first_of(unused, 8)
        findings.shown("unused", f"not used of {capture.path.name}: columns {listed}, which change")
