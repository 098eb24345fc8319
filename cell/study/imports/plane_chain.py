"""The cable's points in the study's plane: shape at rest, arc lengths, and the root's direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError
from cell.study.entries import MAX_ARC_STD_FRACTION
from cell.study.imports.cable_root import (
    A_LINE,
    Root,
    RootEnds,
    root_of_shape,
)
from cell.study.imports.capture import Capture, CapturedColumn, ImportFindings
from cell.study.imports.choosing import Chosen, detected_places
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import Point
from cell.study.imports.gripper_proposal import TIP
from cell.study.imports.gripper_section import AxesSection
from cell.study.imports.places import angle_of
from cell.study.imports.scales import ROUNDED_M, arc_length_stds
from cell.study.imports.shape import (
    FINAL_SHARE,
    arc_lengths,
    middle,
    resting,
    root_direction,
)
from cell.study.imports.stated import Stated
from cell.study.imports.trials import Files
from cell.study.imports.units import METRES, split_unit

#: Largest difference of measured arc lengths from the curve through the markers, share of the last.
_MEASURED_TOL = 0.1
#: Maximum rows of a trial in which the direction of the cable's root is estimated.
_MAX_ROWS = 1000


@dataclass(frozen=True)
class PlaneChain:
    """The chain of points in the study's plane.

    xy_m          (rows, points, 2), the gripping point first where it is in the same file
    arcs          (markers,) from the gripping point, m
    shape         (points, 2) at rest, the gripping point first where that is known
    from_gripper  whether it is known; else arcs start at the first marker
    """

    xy_m: FloatArray
    arcs: FloatArray
    shape: FloatArray
    from_gripper: bool


def scene_of(
    raw: FloatArray, axes: AxesSection, scale: float, rest: FloatArray | None, with_hand: bool
) -> PlaneChain:
    """The chain in the plane.

    rest       (d,) rest position of the gripper of another file; None = unknown
    with_hand  the first of the points is the gripping point
    """
    directions = np.array([axes.right, axes.up])
    xy_m = raw @ directions.T * scale
    shape = shape_at_rest(xy_m)
    if rest is not None:
        shape = np.vstack([directions @ rest * scale, shape])
    # From the mean shape at rest: noise lengthens the curve through points of a single row.
    at_rest = resting(xy_m) is not None and np.isfinite(shape).all()
    lengths = arc_lengths(shape[None] if at_rest or rest is not None else xy_m)
    arcs = lengths[1:] if with_hand or rest is not None else lengths
    # The sag between a gripper and one marker is unknown, as is where a gripper elsewhere is.
    return PlaneChain(xy_m, arcs, shape, with_hand or (rest is not None and len(shape) > A_LINE))


def detected_points(capture: Capture, points: Sequence[Point], chosen: Chosen) -> FloatArray:
    """(rows, points, d) detected positions of points, in the file's unit and axes."""
    of_hand = (chosen.gripper, chosen.second, chosen.clamp)
    return np.stack(
        [detected_places(capture, p.columns, chosen.lost, of_hand=p in of_hand) for p in points],
        axis=1,
    )


def shape_at_rest(raw: FloatArray) -> FloatArray:
    """(points, d) median shape at rest, else of all visible positions."""
    rest = resting(raw)
    return middle(raw if rest is None else rest)


def shapes_of(trials: Sequence[Files], points: Sequence[Point], chosen: Chosen) -> list[FloatArray]:
    """(points, d) shapes at rest of the trials whose files have the same columns."""
    required = {name for p in points for name in p.columns}
    captures = [t.capture for t in trials if required <= set(t.capture.names)]
    shapes = [shape_at_rest(detected_points(c, points, chosen)) for c in captures]
    return [s for s in shapes if np.isfinite(s).all()]


def root_at_rest(scene: PlaneChain, arcs: Sequence[float | None]) -> Root:
    """Clamp angle from the markers at rest."""
    return root_of_shape(scene.shape, arcs, scene.from_gripper)


def root_in_rows(scene: PlaneChain) -> FloatArray:
    """(rows,) clamp angle from the cable's root in some of the rows, else nan."""
    angle = np.full(len(scene.xy_m), np.nan)
    complete = np.flatnonzero(np.isfinite(scene.xy_m).all(axis=(1, 2)))
    complete = complete[:: max(1, len(complete) // _MAX_ROWS)]
    angle[complete] = np.unwrap([angle_of(root_direction(s)) for s in scene.xy_m[complete]])
    return angle


def root_ends(
    trials: Sequence[Files],
    points: Sequence[Point],
    chosen: Chosen,
    axes: AxesSection,
    arcs: Sequence[float | None],
) -> list[RootEnds | None]:
    """The cable's root at the beginning and the end of every trial; None for those that begin in
    motion, or whose file has other columns.

    points  of the cable in the markers' files, the gripping point first where that is known
    """
    required, plane = {name for p in points for name in p.columns}, np.array([axes.right, axes.up])
    ends: list[RootEnds | None] = []
    for files in trials:
        ends.append(None)
        if not required <= set(files.capture.names) or len(points) < A_LINE:
            continue
        xy = detected_points(files.capture, points, chosen) @ plane.T
        shapes = shape_at_rest(xy), middle(xy[int((1.0 - FINAL_SHARE) * len(xy)) :])
        if resting(xy) is None or not np.isfinite(shapes[0]).all():
            continue
        from_gripper = len(points) > len(arcs)
        roots = [root_of_shape(s, arcs, from_gripper) for s in shapes if np.isfinite(s).all()]
        last_rad = roots[1].rest_rad if len(roots) > 1 else np.nan
        std_rad = max(r.std_rad for r in roots)
        source = files.gripper or files.capture
        ends[-1] = RootEnds(source, roots[0].rest_rad, last_rad, std_rad)
    return ends


@dataclass(frozen=True, eq=False)
class MeasuredArcs:
    """Arc lengths of the markers that the user or the columns of a file state.

    arcs_m   (markers,) from the gripper on
    source   who states them
    file     of the markers
    columns  that state them; empty = the user does
    begins   whether the first marker, for which nothing is stated, is at the gripper
    """

    arcs_m: FloatArray
    source: str
    file: Path
    columns: tuple[str, ...] = ()
    begins: bool = False

    def agrees(self, scene: PlaneChain, known: bool) -> bool:
        """Whether they are those of the curve through the markers, or that is unknown.

        What nobody states as arc lengths must agree closely, with a curve that is known.

        known   whether the unit of length is
        raises  InputError: the curve contradicts the user
        """
        curve_m = scene.arcs + (0.0 if scene.from_gripper else self.arcs_m[0] - scene.arcs[0])
        curve_m = curve_m if known else np.full(len(curve_m), np.nan)
        apart_m = np.abs(self.arcs_m - curve_m)
        worst, limit_m = int(np.argmax(apart_m)), float(curve_m[-1])
        limit_m *= TIP if self.begins or self.columns else _MEASURED_TOL
        if self.columns:
            return bool(apart_m[worst] <= limit_m)
        if self.begins and not apart_m[worst] <= limit_m:
            raise InputError.at(self.file, _wrong_count(len(apart_m) - 1, len(apart_m)))
        if apart_m[worst] > limit_m:
            message = f"{self.source} puts marker {worst + 1} from the gripper at "
            message += f"{self.arcs_m[worst]:g} m, yet on the curve through the markers it is at "
            message += f"{curve_m[worst]:.4g} m, limit {limit_m:.2g} m apart; correct the values, "
            raise InputError.at(self.file, f"{message}their order or the unit of length")
        return True


def _wrong_count(given: int, markers: int) -> str:
    return (
        f"--arc-lengths has {given} values, but {markers} markers are found; give one for each, 0 "
        "for one at the gripper"
    )


def measured_arcs(
    capture: Capture, markers: Sequence[Point], stated: Stated, scene: PlaneChain, known: bool
) -> MeasuredArcs | None:
    """Arc lengths that the user states, or perhaps columns; None = nobody does.

    The user may leave out that of a marker at the gripper, or state it for the gripping point.
    Columns of points that have no other meaning may be arc lengths if each has one value, which
    rises along the cable.

    known   whether the unit of length is
    raises  InputError: the user states another number of them, they do not rise, or the curve
            through the markers contradicts them
    """
    if (given := stated.arc_lengths_m) is not None:
        rises = bool(np.all(np.diff(given) > 0.0)) and bool(np.isfinite(given).all())
        if not given or given[0] < 0.0 or not rises:
            message = "--arc-lengths does not rise from the gripper to the tip; order the values so"
            raise InputError.at(capture.path, message)
        begins = len(given) == len(markers) - 1 and given[0] > 0.0
        if begins:
            given = (0.0, *given)
        elif len(given) == len(markers) + 1 and given[0] == 0.0:  # of the gripping point itself
            given = given[1:]
        if len(given) != len(markers):
            raise InputError.at(capture.path, _wrong_count(len(given), len(markers)))
        by_user = MeasuredArcs(np.array(given), "--arc-lengths", capture.path, (), begins)
        return by_user if by_user.agrees(scene, known) else None
    columns: dict[str, dict[str, str]] = {}
    for name in capture.names:
        bare, unit = split_unit(name)
        owner = next((p.name for p in markers if bare.startswith(f"{p.name} ")), "")
        is_other = meaning(CapturedColumn(name)).kind is ColumnKind.OTHER
        if owner and is_other and unit in METRES and np.ptp(capture.column(name)) == 0.0:
            columns.setdefault(bare.removeprefix(f"{owner} "), {})[owner] = name
    for word, column_of in columns.items():
        if len(column_of) != len(markers) or len(markers) < A_LINE:
            continue
        ordered = tuple(column_of[p.name] for p in markers)
        arcs_m = np.array([capture.column(n)[0] * METRES[split_unit(n)[1]] for n in ordered])
        if arcs_m[0] < 0.0 or np.any(np.diff(arcs_m) <= 0.0):
            continue
        by_columns = MeasuredArcs(arcs_m, f"column {word!r}", capture.path, ordered)
        if by_columns.agrees(scene, known):
            return by_columns
    return None


def arcs_of(
    scene: PlaneChain,
    chosen: Chosen,
    stated: Stated,
    known: bool,
    measured: MeasuredArcs | None,
    findings: ImportFindings,
) -> list[float | None]:
    """Arc lengths of the markers, rounded to 10 µm; None where they are unknown.

    known     whether the unit of length is
    measured  None = nobody states them
    """
    if measured is not None:
        report = findings.guessed if measured.columns else findings.stated
        report("markers", f"arc lengths are those of {measured.source}")
        return [float(s) for s in measured.arcs_m]
    lengths, length_m = scene.arcs, stated.free_length_m
    how = "" if chosen.gripper is not None else ", from the gripper's place at rest on"
    if not known or (not scene.from_gripper and length_m is None):
        needs = "needs --free-length" if known else "is known with the unit of length"
        findings.missing("markers", f"where the markers are along the cable {needs}")
        return [None] * len(chosen.markers)
    if not scene.from_gripper and length_m is not None:
        lengths = lengths + length_m - lengths[-1]
        reason = "no place of the gripper at rest is known in their frame"
        if len(scene.shape) > scene.xy_m.shape[1]:
            reason = "one marker shows no curve from the gripper on"
        how = f", {chosen.markers[-1].name!r} taken as the cable's tip, for {reason}"
    if not np.isfinite(lengths).all():
        sentence = "where the markers are along the cable is not known, for no row shows "
        findings.missing("markers", f"{sentence}two neighbours of each; measure arc_length_m")
        return [None] * len(chosen.markers)
    arcs = [round(float(s), 5) for s in lengths]
    if length_m is not None and 0.0 < arcs[-1] - length_m <= TIP * length_m:
        arcs[-1] = length_m
    sentence = f"arc lengths are those of a curve through the markers, {arcs[0]:g} … {arcs[-1]:g} m"
    findings.guessed("markers", f"{sentence}{how}; measured ones are better")
    if length_m is None:
        sentence = f"the cable ends at its last marker: {arcs[-1]:g} m long; give --free-length"
        findings.guessed("cable.free_length_m", sentence)
    elif arcs[-1] > length_m:
        sentence = f"the markers span {arcs[-1]:g} m from the gripper, the cable {length_m:g} m: "
        sentence += "is the gripper's place, a unit or --free-length wrong, or are points of the "
        sentence += "gripper to be called gripper_1, gripper_2? If a point is not on the cable, "
        sentence += "take its columns out of the file and propose the mapping again"
        findings.guessed("markers", sentence)
    elif arcs[-1] < (1.0 - TIP) * length_m:
        sentence = f"the last {length_m - arcs[-1]:.3g} m of the cable, beyond marker "
        sentence += f"{chosen.markers[-1].name!r}, has no marker, by --free-length"
        findings.guessed("cable.free_length_m", sentence)
    return list(arcs)


def arc_stds(
    scene: PlaneChain,
    stated: Stated,
    arcs: Sequence[float | None],
    measured: MeasuredArcs | None,
    findings: ImportFindings,
) -> list[float | None]:
    """Standard deviations of the arc lengths, m; None where these are measured or unknown."""
    last_m, places_m = arcs[-1], scene.xy_m
    if scene.from_gripper and len(scene.shape) > places_m.shape[1]:
        places_m = np.insert(places_m, 0, scene.shape[0], axis=1)
    if measured is not None or last_m is None or places_m.shape[1] < A_LINE:
        return [None] * len(arcs)
    length_m = stated.free_length_m or last_m
    stds = arc_length_stds(places_m, length_m, scene.from_gripper)
    excess_m = float(scene.arcs[-1]) - last_m if scene.from_gripper else 0.0
    if excess_m > max(stds[-1], ROUNDED_M):  # a tip is on the cable, though the curve is longer
        std_m = float(f"{np.hypot(stds[-1], excess_m):.2g}")
        stds[-1] = min(std_m, MAX_ARC_STD_FRACTION * length_m)
        sentence = f"the curve is {excess_m * 1e3:.2g} mm longer than the cable: its last marker "
        findings.guessed("markers", f"{sentence}is taken as the tip")
    low, high = (f"{v * 1e3:.2g}" for v in (stds.min(), stds.max()))
    findings.guessed(
        "markers",
        f"arc_length_std_m, {low if low == high else f'{low} … {high}'} mm, is what noise and the "
        "bend between markers leave open; give your own where you measure",
    )
    return [float(s) for s in stds]
