"""Files and a mapping → a study; every problem names file, line and column of the input."""

from __future__ import annotations

from collections.abc import Mapping as Dictionary
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from cell.cable.arrays import FloatArray
from cell.cable.geometry import ROUGHLY_STILL, Cable, Motion, moves_from_s
from cell.files.input_error import InputError, Problem
from cell.files.yaml_document import Key
from cell.study.check import Failure, failures
from cell.study.data import Markers, Source, Study, Trial, WrenchSensor
from cell.study.entries import MAX_LENGTH_M, datasheet_of, implausible_entries
from cell.study.import_checks import IMPORT_NOTES, IMPORT_REFUSALS, IMPORT_SHAPE
from cell.study.imports.angle_check import angle_problem
from cell.study.imports.capture import Capture
from cell.study.imports.clamp_angle import MOST_RAD
from cell.study.imports.contents import with_names
from cell.study.imports.estimates import with_estimates
from cell.study.imports.gripper_path import GripperPath, gripper_path
from cell.study.imports.gripper_section import TimeSection
from cell.study.imports.joined_files import joined
from cell.study.imports.mapping import Mapping, ReadMapping, TrialEntry
from cell.study.imports.places import out_of_plane_m, places_m
from cell.study.imports.read import read_capture
from cell.study.imports.row_trials import rows_of
from cell.study.imports.scales import WRONG_UNIT, other_rate, times_s
from cell.study.trial_checks import TrialEvidence, trial_problems

#: A unit of angles below this many radians is not the radian.
_DEGREES = 0.1


@dataclass(frozen=True)
class Imported:
    """An imported study, with one warning for each oddity of its files."""

    study: Study
    notes: tuple[str, ...]


def read_captures(read: ReadMapping) -> dict[str, Capture]:
    """All files that a mapping names, each read once.  Raises InputError."""
    each = [(t, read.mapping.of_trial(t)) for t in read.mapping.trials]
    forms = {t.file: mapping.text for t, mapping in each}
    forms |= {t.hand_file: mapping.hand.text for t, mapping in each if t.hand_file is not None}
    captures = {name: read_capture(read.file(name), form) for name, form in forms.items()}
    for trial, _ in each:
        if trial.joined_files:
            others = [read_capture(read.file(name)) for name in trial.joined_files]
            captures[trial.file] = joined([captures[trial.file], *others])
    return captures


def study_of(read: ReadMapping, captures: Dictionary[str, Capture]) -> Imported:
    """The study that a mapping makes of files.

    captures  by the name that the mapping gives them
    raises    InputError: a file is wrong, or the mapping contradicts what is in it
    """
    mapping = read.mapping
    arcs = np.array([m.arc_length_m for m in mapping.markers], dtype=np.float64)
    order = np.argsort(-arcs, kind="stable")
    arcs, stds = arcs[order], _arc_length_std_m(mapping, order)
    cable = _cable(read, arcs, stds, order)
    problems, constants = list[Problem](), list[Problem]()
    read, estimates = with_estimates(read, captures)
    mapping = read.mapping
    notes = [*(note for capture in captures.values() for note in capture.notes), *estimates]
    trials: list[Trial] = []
    for i, entry in enumerate(mapping.trials):
        try:
            measured = _read_trial(read.of_trial(entry), entry, captures, order)
            _check_unit(read, measured.trial, arcs)
            _check_origin(read, measured.trial, arcs, cable.length_m)
        except InputError as error:
            problems += error.problems
            continue
        if (complaint := measured.trial.release_complaint) is not None:
            problems.append(read.document.problem(("trials", i, "release_s"), complaint))
            continue
        refusals, remarks = _check_trial(measured, cable, arcs, mapping.gravity_m_per_s2)
        source = rows_of(captures[entry.hand_file or entry.file], entry.only)
        wrong_angle = angle_problem(read.of_trial(entry), measured.trial, arcs, source)
        if wrong_angle is not None and mapping.hand.angle.constant_rad is not None:
            constants.append(wrong_angle)
        elif wrong_angle is not None and (mapping.hand.angle.body_axis or not refusals):
            refusals = [wrong_angle, *refusals]
        problems += refusals
        notes += [*measured.notes, *remarks]
        trials.append(measured.trial)
        if entry.start in ("straight", "held") and entry.release_s is None:
            message = f"is missing; `start: {entry.start}` needs the time of letting go"
            problems.append(read.document.problem(("trials", i, "release_s"), message))
    if not problems and mapping.hand.angle.constant_rad is not None:
        problems = _rest_direction_problems(read, trials, arcs, cable.length_m) or constants
    if problems:
        raise InputError(problems)
    study = Study(
        mapping.name,
        cable,
        arcs,
        tuple(trials),
        mapping.gravity_m_per_s2,
        mapping.noise_std_m,
        arc_length_std_m=stds,
        sensor=WrenchSensor() if mapping.wrench is None else mapping.wrench.sensor(),
    )
    return Imported(study, tuple(notes))


#: Largest distance of a gripper from the start of the curve at rest, as shares of the free length
#: and of the first marker's arc length.
_APART, _APART_OF_ARC = 0.05, 0.5


def _places_at_rest(trial: Trial, arcs: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """(2,) gripping point, and (2,) start of the curve through the markers; None = not known.

    arcs  (markers,) from the tip on
    """
    at_rest = trial.markers.t_s < moves_from_s(trial.grip, ROUGHLY_STILL)
    if trial.bent or not at_rest.any() or len(arcs) < 3 or np.any(np.diff(arcs) >= 0.0):
        return None
    shown = trial.markers.xy_m[at_rest]
    if not np.isfinite(shown).all(axis=2).any(axis=0).all():
        return None
    curve = CubicSpline(arcs[::-1], np.nanmedian(shown, axis=0)[::-1])
    return np.array([trial.grip.x_m[0], trial.grip.y_m[0]]), curve(0.0)


def _check_origin(read: ReadMapping, trial: Trial, arcs: FloatArray, length_m: float) -> None:
    """Raise InputError where an origin puts the gripper away from the start of the cable."""
    shown, hand = _places_at_rest(trial, arcs), read.mapping.hand
    if shown is None or not hand.columns or (hand.origin_m == (0.0, 0.0) and hand.axes is None):
        return
    limit_m = max(_APART * length_m, _APART_OF_ARC * float(arcs[-1]))
    apart_m = float(np.linalg.norm(shown[1] - shown[0]))
    if apart_m > limit_m:
        (x_m, y_m), (start_x_m, start_y_m) = shown
        raise read.error(
            ("hand", "origin_m"),
            f"puts the gripper of {trial.name} at [{x_m:.4g}, {y_m:.4g}] m at rest, yet the curve "
            f"through the markers begins at [{start_x_m:.4g}, {start_y_m:.4g}] m by their "
            f"arc_length_m, {apart_m:.3g} m away, limit {limit_m:.2g} m; give null to have it "
            "estimated, or correct metres_per_unit or arc_length_m",
        )


@dataclass(frozen=True)
class _ImportedTrial:
    """A trial, and the file that its markers come from.

    detected  (rows of the file,) whether a row is a frame
    across_m  (T, markers) coordinate across the plane; None = the file has two coordinates
    notes     remarks on the file and the gripper's path, one sentence each
    """

    trial: Trial
    capture: Capture
    detected: NDArray[np.bool_]
    across_m: FloatArray | None
    notes: tuple[str, ...]

    def problem(self, failure: Failure, sentence: str) -> Problem:
        """A problem of a row of the trial."""
        row = int(np.flatnonzero(self.detected)[failure.row or 0])
        column = "time" if failure.column == "t_s" else failure.column
        return self.capture.problem(row, sentence, column)


def _check_trial(
    measured: _ImportedTrial, cable: Cable, arcs: FloatArray, gravity: tuple[float, float]
) -> tuple[list[Problem], list[str]]:
    trial = measured.trial
    evidence = TrialEvidence(trial, cable, arcs, gravity, measured.across_m)
    problems = [measured.problem(*each) for each in failures(IMPORT_REFUSALS, evidence)]
    if not problems:
        problems = [measured.problem(*each) for each in islice(failures(IMPORT_SHAPE, evidence), 1)]
    if problems:
        return problems, []
    notes = []
    for failure, sentence in failures(IMPORT_NOTES, evidence):
        line = "" if failure.row is None else f":{measured.problem(failure, '').line}"
        notes.append(f"{measured.capture.path}{line}: {sentence}")
    problems, more = trial_problems(trial, cable, arcs, gravity)
    return problems, [*notes, *more]


#: Tolerance of the rest directions of trials whose clamp angle is constant, rad, and least arc
#: length of a marker that shows one, as a share of the free length.
_REST_LIMIT, _AWAY_SHARE = 0.05, 0.05


def _rest_direction_problems(
    read: ReadMapping, trials: list[Trial], arcs: FloatArray, length_m: float
) -> list[Problem]:
    """Problem if trials differ in rest direction, but the mapping has a constant clamp angle.

    arcs  (markers,) arc lengths, the tip first
    """
    rests = []
    away = np.flatnonzero(arcs >= _AWAY_SHARE * length_m)
    if not len(away):
        return []
    for trial in trials:
        at_rest = trial.markers.t_s < moves_from_s(trial.grip, ROUGHLY_STILL)
        nearest_m = trial.markers.xy_m[at_rest, away[-1]]
        nearest_m = nearest_m[np.isfinite(nearest_m).all(axis=1)]
        if trial.bent or not len(nearest_m):
            continue
        way_m = np.median(nearest_m, axis=0) - [trial.grip.x_m[0], trial.grip.y_m[0]]
        rests.append((float(np.arctan2(-way_m[1], -way_m[0])), trial.name))
    if len(rests) < 2:
        return []
    (low, first), (high, last) = min(rests), max(rests)
    if high - low < _REST_LIMIT:
        return []
    message = (
        "is one constant, yet at rest the marker next to the gripper is at "
        f"{np.degrees(low):.1f}° in "
        f"{first} and at {np.degrees(high):.1f}° in {last}, limit {np.degrees(_REST_LIMIT):.1f}° "
        "apart; give a column of the angle, or make studies of their own of these trials"
    )
    return [read.document.problem(("hand", "angle", "constant_rad"), message)]


def trials_of(
    read: ReadMapping, captures: Dictionary[str, Capture]
) -> tuple[list[Trial], list[Problem]]:
    """Trials that can be shown with an incomplete mapping, and the problems of the others.

    Lengths are in the file's unit where the mapping lacks metres_per_unit, and times likewise.  A
    gripper with an unknown path does not move.
    """
    # A proposal has the marker at the gripper first.
    order = np.arange(len(read.mapping.markers))[::-1]
    if read.mapping.hand.unfinished:
        hand = read.mapping.hand.standing_still()
        read = ReadMapping(read.mapping.model_copy(update={"hand": hand}), read.document)
    trials: list[Trial] = []
    problems: list[Problem] = []
    for entry in read.mapping.trials:
        try:
            trials.append(_read_trial(read.of_trial(entry), entry, captures, order).trial)
        except InputError as error:
            problems += error.problems
    return trials, problems


def _arc_length_std_m(mapping: Mapping, order: NDArray[np.intp]) -> FloatArray | None:
    """(markers,) of the mapping, 0 where a position is exact; None = all are."""
    stds_m = [m.arc_length_std_m for m in mapping.markers]
    if all(std_m is None for std_m in stds_m):
        return None
    return np.array([std_m or 0.0 for std_m in stds_m])[order]


def _cable(
    read: ReadMapping, arcs: FloatArray, stds: FloatArray | None, order: NDArray[np.intp]
) -> Cable:
    """The datasheet.  Raises InputError: entries of the mapping that no study may have.

    arcs, stds  (markers,) arc lengths and their standard deviations, the tip first
    """
    entries = read.mapping.cable.model_dump(exclude_none=True)
    datasheet = datasheet_of(entries)
    complaints = implausible_entries(
        entries, datasheet, read.mapping.gravity_m_per_s2, arcs.tolist(),
        read.mapping.noise_std_m, () if stds is None else stds.tolist(),
    )  # fmt: skip
    problems = [read.document.problem(_key_of(key, order), text) for key, text in complaints]
    if problems or datasheet is None:
        raise InputError(problems)
    return datasheet


def _key_of(key: Key, order: NDArray[np.intp]) -> Key:
    """Key in the mapping of a study's entry: arc lengths are entries of their markers."""
    if key[0] != "markers" or len(key) < 2:
        return key
    return "markers", int(order[int(key[2])]) if len(key) > 2 else 0, key[1]


def _read_trial(
    read: ReadMapping,
    entry: TrialEntry,
    captures: Dictionary[str, Capture],
    order: NDArray[np.intp],
) -> _ImportedTrial:
    """One trial, with the lines and names of its file."""
    mapping = read.mapping
    columns = [name for m in mapping.markers for name in m.columns]
    columns += [] if entry.hand_file else mapping.hand.columns or []
    capture = _renamed(rows_of(captures[entry.file], entry.only), columns, mapping.time)
    t_s = times_s(capture, mapping.time)
    zero_s = float(t_s[0]) if mapping.time.starts_at_zero else 0.0
    scale = mapping.metres_per_unit or 1.0
    entries = [mapping.markers[int(i)] for i in order]
    xy_m = np.stack(
        [places_m(capture, m.columns, mapping.axes, scale, mapping.lost) for m in entries], axis=1
    )
    across = [
        out_of_plane_m(capture, m.columns, mapping.axes, scale, mapping.lost) for m in entries
    ]
    detected: NDArray[np.bool_] = np.asarray(np.isfinite(xy_m).any(axis=(1, 2)))
    if np.count_nonzero(detected) < 2:
        names = ", ".join(m.name for m in entries)
        raise capture.error(0, f"shows {names} in fewer than 2 rows; give columns with numbers")
    if mapping.frames is not None:
        detected |= np.nan_to_num(capture.column(mapping.frames)) != 0.0
    source = Source(capture.path, capture.lines[detected], order, tuple(m.name for m in entries))
    markers = Markers(t_s[detected] - zero_s, xy_m[detected], source)
    motion, path = _motion(read, entry, captures, zero_s, markers)
    drift = entry.hand_drift or path.drift
    wrench = None if mapping.wrench is None else mapping.wrench.wrench(capture, t_s - zero_s)
    trial = Trial(
        entry.name, entry.role, entry.start, motion, markers, entry.release_s, drift, wrench
    )
    depths = [a[detected] for a in across if a is not None]
    across_m = np.stack(depths, axis=1) if len(depths) == len(across) else None
    remarks = path.note, other_rate(capture, mapping.time)
    notes = (*capture.notes, *(note for note in remarks if note))
    return _ImportedTrial(trial, capture, detected, across_m, notes)


def _renamed(capture: Capture, columns: Sequence[str | None], time: TimeSection) -> Capture:
    """The file with its columns renamed as in the mapping, and a note on each."""
    named, others = with_names(capture, [n for n in columns if n is not None], time.column)
    notes = [f"{capture.path}: column {own!r} is taken as {name!r}" for name, own in others.items()]
    return replace(named, notes=tuple(notes))


def _motion(
    read: ReadMapping,
    entry: TrialEntry,
    captures: Dictionary[str, Capture],
    zero_s: float,
    markers: Markers,
) -> tuple[Motion, GripperPath]:
    """Pose of the gripping point, and how it is known.

    raises  InputError: it is missing somewhere, or on no clock
    """
    mapping, hand = read.mapping, read.mapping.hand
    columns, time = list(hand.columns or ()), hand.time or mapping.time
    capture = _renamed(rows_of(captures[entry.hand_file or entry.file], entry.only), columns, time)
    t_s = times_s(capture, time) - zero_s + (entry.clock_offset_s or 0.0)
    path = gripper_path(read, entry, capture, t_s)
    xy_m, angle_rad = path.xy_m, path.angle_rad
    known = np.isfinite(xy_m).all(axis=1) & np.isfinite(angle_rad)
    if np.count_nonzero(known) < 2:
        raise capture.error(0, "tells the gripper's place and angle in fewer than 2 rows", "hand")
    rows = np.flatnonzero(known)
    if np.abs(angle_rad[known]).max() > MOST_RAD:
        row = int(rows[np.argmax(np.abs(angle_rad[known]))])
        remedy = "give radians_per_unit: 0.0174533 for degrees"
        if hand.angle.column is None or abs(hand.angle.radians_per_unit or 1.0) < _DEGREES:
            remedy = "take whole turns off, of 6.28319 rad each, by offset_rad of hand.angle"
            if np.ptp(angle_rad[known]) > 2.0 * MOST_RAD:
                remedy = "it turns too far for a clamp: give constant_rad, or another column"
        raise capture.error(
            row,
            f"is {angle_rad[row]:.4g} rad, limit ±2π; {remedy}",
            hand.angle.column or "hand.angle",
        )
    span, frames_s = t_s[known], markers.t_s
    if frames_s[-1] < span[0] or frames_s[0] > span[-1]:
        raise capture.error(
            int(rows[0]),
            f"the gripper is known from {span[0]:.6g} to {span[-1]:.6g} s, the markers from "
            f"{frames_s[0]:.6g} to {frames_s[-1]:.6g} s; give clock_offset_s of the trial, "
            "or null to have it estimated",
        )
    values = (span, xy_m[known, 0], xy_m[known, 1], angle_rad[known])
    return Motion(*(np.ascontiguousarray(v) for v in values)), path


def _same_unit(long_m: FloatArray, cable_m: FloatArray) -> bool:
    totals = float(long_m.sum()), float(cable_m.sum())
    return min(totals) <= 0.0 or 1.0 / WRONG_UNIT < totals[0] / totals[1] < WRONG_UNIT


def _check_unit(read: ReadMapping, trial: Trial, arcs: FloatArray) -> None:
    """Raise InputError where the chain of markers is by far longer or shorter than the cable."""
    mapping, at_m = read.mapping, trial.gripper_m(trial.markers.t_s)
    chain = np.concatenate([trial.markers.xy_m, at_m[:, None]], axis=1)
    hand = mapping.hand
    own_frame = hand.origin_m != (0.0, 0.0) or hand.axes is not None
    if own_frame or hand.turns is not None or hand.acceleration is not None:
        chain = chain[:, :-1]
    steps = np.linalg.norm(np.diff(chain, axis=1), axis=2)
    good = np.isfinite(steps).any(axis=0)
    if not good.any():
        return
    each_m = np.nanmedian(steps[:, good], axis=0)
    cables_m = np.abs(np.diff(np.append(arcs, 0.0)))[: steps.shape[1]][good]
    if _same_unit(each_m, cables_m):
        return
    long_m, cable_m = float(each_m.sum()), float(cables_m.sum())
    scale = mapping.metres_per_unit or 1.0
    if steps.shape[1] == len(arcs) and len(each_m) > 1 and _same_unit(each_m[:-1], cables_m[:-1]):
        raise read.error(
            ("hand",),
            f"is {each_m[-1]:.4g} m from the nearest marker of {trial.name}, with "
            f"{cables_m[-1]:.4g} m of cable between them; give origin_m, where the origin of the "
            "gripper's places is in the markers' frame, or correct its metres_per_unit",
        )
    fitting = scale * cable_m / long_m
    nearest = min((1.0, 0.1, 0.01, 0.001, 1e-6, 0.0254), key=lambda u: abs(np.log(u / fitting)))
    beyond = f" (no cable may be longer than {MAX_LENGTH_M:g} m)" if long_m > MAX_LENGTH_M else ""
    raise read.error(
        ("metres_per_unit",),
        f"{scale:g} makes the markers of {trial.name} {long_m:.4g} m from end to end{beyond}, yet "
        f"their arc lengths span {cable_m:.4g} m; give {nearest:g}, or correct arc_length_m",
    )
