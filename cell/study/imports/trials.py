"""The files of the trials, and their entries in the proposed mapping: start, role, clock, rate."""

from __future__ import annotations

import re
from collections.abc import Mapping as Dictionary
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from unicodedata import combining, normalize

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.alignment import (
    Alignment,
    GripperTrack,
    align,
    align_root,
    turned_as,
)
from cell.study.imports.capture import Capture, ImportFindings, Sure
from cell.study.imports.contents import Point, contents
from cell.study.imports.gripper_path import interpolated
from cell.study.imports.gripper_section import TimeSection
from cell.study.imports.groups import PART
from cell.study.imports.mapping import Mapping, TrialEntry
from cell.study.imports.places import clamp_angle_rad, places_m
from cell.study.imports.row_trials import TrialLabel
from cell.study.imports.scales import counts_frames, time_section, times_s
from cell.study.imports.shape import FEWEST_REST, rest_rows
from cell.study.series import span_m


@dataclass(frozen=True)
class Files:
    """A trial's files as the mapping names them, and what they hold.

    joined_files  other files with the same times, whose columns are in the first one's capture
    only  column values that select its rows; empty = all rows
    """

    name: str
    file: str
    capture: Capture
    gripper_file: str | None = None
    gripper: Capture | None = None
    joined_files: tuple[str, ...] = ()
    only: Dictionary[str, TrialLabel] = field(default_factory=dict)

    @property
    def in_one(self) -> bool:
        """Whether markers and gripper are parts of one file, which one program wrote."""
        container = self.file.partition(PART)[0]
        return PART in self.file and (self.gripper_file or "").partition(PART)[0] == container


def unique_names(labels: Sequence[str]) -> list[str]:
    """Unique names of trials, made from labels."""
    names: list[str] = []
    for label in labels:
        label = "".join(c for c in normalize("NFKD", label) if not combining(c))  # ä → a
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", label).strip("_.-") or "trial"
        number = 2
        unique = name
        while unique in names:
            unique, number = f"{name}_{number}", number + 1
        names.append(unique)
    return names


def trial_entries(
    trials: Sequence[Files],
    mapping: Mapping,
    rate_hz: float | None,
    findings: ImportFindings,
    clamp: Point | None,
) -> list[TrialEntry]:
    """Start, role and clock of every trial, and entries in which its files differ.

    clamp     point of the gripper in the markers' files; None = they have none
    rate_hz   rows a second that the user states for all files of markers
    findings  findings about the trials are added
    raises    InputError: times are in disorder, or a column is missing
    """
    entries: list[TrialEntry] = []
    shared_s = _shared_clock(trials, mapping, clamp, findings)
    for number, (files, entry) in enumerate(zip(trials, mapping.trials, strict=True)):
        role = "validate" if len(trials) > 1 and number == len(trials) - 1 else "fit"
        overrides = _overrides(files, mapping, rate_hz, findings)
        entry = entry.model_copy(update={"role": role, **overrides})
        of_trial = mapping.of_trial(entry)
        if of_trial.time.seconds_per_unit is not None and mapping.metres_per_unit is not None:
            entry = entry.model_copy(
                update=_start_and_clock(files, of_trial, clamp, findings, shared_s)
            )
        entries.append(entry)
    if len(trials) > 1:
        sentence = f"{trials[-1].name} is kept for comparison (role validate), the others are "
        findings.guessed("trials", f"{sentence}fitted")
    return entries


def _overrides(
    files: Files, mapping: Mapping, rate_hz: float | None, findings: ImportFindings
) -> dict[str, Any]:
    """Entries of a trial in which its files differ from the first trial's."""
    hand = mapping.hand
    overrides: dict[str, Any] = {}
    sources = [("", files.capture, mapping.text, mapping.time, rate_hz)]
    if files.gripper is not None:
        sources.append(("hand_", files.gripper, hand.text, hand.time or mapping.time, None))
    for prefix, capture, text, time, stated_hz in sources:
        if (form := capture.form) is not None and form != text:
            overrides[f"{prefix}text"] = form
            sentence = f"{capture.path.name}: cells are separated by {form.separator!r}, "
            findings.shown("trials.text", f"{sentence}the decimal mark is {form.decimal!r}")
        unit = _seconds_per_unit(capture, time, stated_hz, findings)
        if unit is not None:
            overrides[f"{prefix}seconds_per_unit"] = unit
    return overrides


def _seconds_per_unit(
    capture: Capture, section: TimeSection, rate_hz: float | None, findings: ImportFindings
) -> float | None:
    """Seconds a unit of a file's times, if it differs from the first file's; else None."""
    stated, finding = time_section(capture, contents(capture), rate_hz)
    unit, first_unit = stated.seconds_per_unit, section.seconds_per_unit
    if stated.column != section.column or unit == first_unit:
        return None
    entry, name = "trials.seconds_per_unit", capture.path.name
    if finding.sure is Sure.STATED and unit is not None:
        findings.stated(entry, f"{name}: {finding.sentence}")
        return unit
    if finding.sure is Sure.MISSING and first_unit is not None:
        sentence = f"{name} states no rate: it is taken as that of the first trial, "
        findings.guessed(entry, f"{sentence}{1.0 / first_unit:g} rows a second")
    return None


#: Maximum share of a point's motion that the gripper's does not explain, if they move as one.
_SAME_POINT = 0.02
#: Minimum clock offset that a point of the gripper shows, in standard deviations.
_SIGMAS = 3.0
#: Minimum clock offset that is proposed, in rows, where both clocks should be one; else as a share
#: of a row.
ROWS_OFF, _SHARE_OF_ROW = 1.5, 0.1
#: Maximum arc length, as a fraction of the cable, of a marker that follows the gripper closely.
NEAR_HAND = 0.35
#: Time zones differ by multiples of half an hour; maximum difference, s.
_HALF_HOUR_S, _FARTHEST_S = 1800.0, 14 * 3600.0
#: Minimum displacement of a moving gripper, as a fraction of the cable's length.
_MIN_MOTION = 0.01
#: Factor on the tolerances of a clock offset that several trials in the rows of the same files
#: show, as these must agree.
_JOINT = 0.5


def _shared_clock(
    trials: Sequence[Files], mapping: Mapping, clamp: Point | None, findings: ImportFindings
) -> float | None:
    """Offset of the gripper's clock, s, where all trials are in the rows of the same files.

    None = they are not, or their motions show no common offset.
    """
    time, hand_time = mapping.time, mapping.hand.time or mapping.time
    file_pairs = {(t.file, t.gripper_file) for t in trials if t.only and t.gripper is not None}
    if len(trials) < 2 or len(file_pairs) != 1 or not all(t.only for t in trials):
        return None
    if not _comparable(mapping) or counts_frames(time) or counts_frames(hand_time):
        return None
    shifts, weights, steps = [], [], []
    for files in trials:
        t_s = times_s(files.capture, time)
        hand = gripper_path_of(files, mapping)
        aligned = aligned_gripper(files, mapping, clamp)
        steps.append(float(max(np.median(np.diff(hand.t_s)), np.median(np.diff(t_s)))))
        if aligned is not None:
            shifts.append(aligned.shift_s)
            weights.append(span_m(hand.xy_m) ** 2)
    if not shifts:
        return None
    shift_s = round(float(np.average(shifts, weights=weights)), 4)
    spread_s = float(np.sqrt(np.average((np.array(shifts) - shift_s) ** 2, weights=weights)))
    if not max(steps) * _JOINT * ROWS_OFF < abs(shift_s) or spread_s > _JOINT * max(steps):
        return None
    sentence = f"{shift_s:+g} s are added to the gripper's clock in all trials, so that both move "
    findings.guessed("clock_offset_s", f"{sentence}at once: each shows it, and they have one clock")
    return shift_s


def _start_and_clock(
    files: Files,
    mapping: Mapping,
    clamp: Point | None,
    findings: ImportFindings,
    shared_s: float | None,
) -> dict[str, Any]:
    """Entries `start`, `release_s` and `clock_offset_s` of a trial.

    shared_s  common clock offset of all trials, s; None = estimate that of this trial
    raises  InputError: times are in disorder, or a column is missing
    """
    name, capture, hand = files.name, files.capture, files.gripper
    t_s = times_s(capture, mapping.time)
    zero_s = float(t_s[0]) if mapping.time.starts_at_zero else 0.0
    t_s = t_s - zero_s
    xy_m = markers_m(capture, mapping)
    offset_s, gripper, length_m = 0.0, None, mapping.cable.free_length_m or 1.0
    is_known = True
    hand_time = mapping.hand.time or mapping.time
    is_timed = hand_time.seconds_per_unit is not None
    if is_timed and mapping.hand.columns is not None:
        track = gripper_path_of(files, mapping)
        hand_s, hand_m = track.t_s, track.xy_m
        zone_s = _zone_s(name, hand_s, t_s, findings)
        hand_s = hand_s + zone_s
        if shared_s is not None:
            offset_s = shared_s
        elif hand is not None:
            offset_s = _row_offset(name, capture, t_s, hand_s, findings)
        if hand is not None and not offset_s:
            is_counted = counts_frames(mapping.time) and not counts_frames(hand_time)
            first_s = zero_s if is_counted else 0.0
            shift_s = _clock(files, mapping, clamp, first_s + zone_s, findings)
            is_known, offset_s = shift_s is not None, shift_s or 0.0
            if first_s:
                offset_s = round(first_s + offset_s, 6)
                sentence = f"{name}: column {mapping.time.column!r} counts frames: the first is "
                sentence += "taken as time 0 of the gripper's file, unless said otherwise"
                findings.guessed("clock_offset_s", sentence)
        hand_s = hand_s + offset_s
        if is_known or (hand_s[0] < t_s[-1] and t_s[0] < hand_s[-1]):
            gripper = hand_s, hand_m
        offset_s += zone_s
    elif hand is not None:
        sentence = f"{name}: whether both clocks agree is not known before the gripper's path is"
        findings.guessed("clock_offset_s", sentence)
    visible = np.isfinite(xy_m).any(axis=(1, 2))
    entries = _start(name, (t_s[visible], xy_m[visible]), gripper, length_m, findings)
    return entries | ({"clock_offset_s": offset_s} if offset_s else {})


def _zone_s(name: str, hand_s: FloatArray, frame_s: FloatArray, findings: ImportFindings) -> float:
    """Time-zone offset of the gripper's clock, in multiples of half an hour, s; 0 = none.

    It is assumed only if the time spans do not overlap without it.
    """
    limit_s = 0.5 * float(np.ptp(hand_s) + np.ptp(frame_s))
    gap_s = 0.5 * float(frame_s[0] + frame_s[-1] - hand_s[0] - hand_s[-1])
    zone_s = _HALF_HOUR_S * round(gap_s / _HALF_HOUR_S)
    if abs(gap_s) <= limit_s or abs(gap_s - zone_s) > limit_s or abs(zone_s) > _FARTHEST_S:
        return 0.0
    sentence = f"{name}: {zone_s:+g} s, {zone_s / 3600.0:+g} h, are added to the gripper's clock: "
    findings.guessed("clock_offset_s", f"{sentence}one of the files seems to be in local time")
    return zone_s


def _comparable(mapping: Mapping) -> bool:
    """Whether the gripper's columns, both files' times and the unit of length are known."""
    times = mapping.time, mapping.hand.time or mapping.time
    known = mapping.hand.columns is not None and mapping.metres_per_unit is not None
    return known and all(t.seconds_per_unit for t in times)


def markers_m(capture: Capture, mapping: Mapping) -> FloatArray:
    """(rows, markers, 2) positions, nan where they are not seen."""
    frame = mapping.axes, mapping.metres_per_unit or 1.0, mapping.lost
    return np.stack([places_m(capture, m.columns, *frame) for m in mapping.markers], axis=1)


def gripper_path_of(files: Files, mapping: Mapping) -> GripperTrack:
    """The gripper's track in the study's axes, on the clock of its own file."""
    section, source = mapping.hand, files.gripper or files.capture
    assert section.columns is not None  # a proposal has no fixed gripper
    t_s, _ = _times_s(files, mapping)
    scale = section.metres_per_unit or mapping.metres_per_unit or 1.0
    axes, lost = section.axes or mapping.axes, mapping.lost
    at_m = places_m(source, section.columns, axes, scale, lost, unseen=0.0, of_hand=True)
    still, angle = np.zeros((len(t_s), 2)), clamp_angle_rad(source, section.angle, axes)
    if angle is not None and np.isfinite(angle).any():
        angle = interpolated(t_s, angle)
        still = -np.column_stack([np.cos(angle), np.sin(angle)])
    known = np.isfinite(at_m + still).all(axis=1)
    return GripperTrack(t_s[known], at_m[known], still[known])


def _row_offset(
    name: str, capture: Capture, t_s: FloatArray, hand_s: FloatArray, findings: ImportFindings
) -> float:
    """Offset to a clock that counts frames from 0 or 1, s; 0 = gripper and markers do not have the
    same rows."""
    offset_s = float(t_s[0] - hand_s[0])
    step_s = float(np.median(np.diff(t_s)))
    equal_rows = len(t_s) == len(hand_s) and np.allclose(t_s - offset_s, hand_s, atol=0.1 * step_s)
    if capture.counted != "frame" or not equal_rows or not 0.0 < abs(offset_s) < ROWS_OFF * step_s:
        return 0.0
    offset_s = round(offset_s, 6)
    findings.guessed(
        "clock_offset_s",
        f"{name}: gripper and markers have {len(t_s)} rows at one rate and are taken row by row: "
        f"{offset_s:+g} s are added to the gripper's clock",
    )
    return offset_s


def _clock(
    files: Files, mapping: Mapping, clamp: Point | None, added_s: float, findings: ImportFindings
) -> float | None:
    """Offset of the gripper's clock, s; 0 = both agree, None = no motion near the gripper shows it.

    added_s  to the gripper's times before
    """
    name, aligned = files.name, aligned_gripper(files, mapping, clamp)
    if aligned is None:
        sentence = f"{name}: {_why_unknown(files, mapping)}: whether both clocks agree is not known"
        findings.guessed("clock_offset_s", sentence)
        return None
    if aligned.is_turned:
        sentence = f"{name}: the gripper's path is turned or mirrored against the marker next to it"
        findings.guessed("hand.axes", f"{sentence}: axes, or hand.axes, are wrong")
    hand_s, t_s = _times_s(files, mapping)
    shift_s = round(aligned.shift_s - added_s, 4)
    limit_s = clock_limit_s(files, mapping, aligned)
    if abs(shift_s) <= limit_s:
        sentence = f"{name}: both clocks agree within {limit_s * 1e3:.3g} ms"
        findings.shown("clock_offset_s", sentence)
        return 0.0
    if files.in_one and hand_s[0] + added_s < t_s[-1] and t_s[0] < hand_s[-1] + added_s:
        sentence = f"{name}: gripper and markers are in one file, and so on one clock, though both "
        sentence += f"move at once if the gripper's is {shift_s:+g} s later; give clock_offset_s if"
        findings.guessed("clock_offset_s", f"{sentence} that is right")
        return 0.0
    how = f"it and {clamp.name!r} move" if clamp is not None and aligned.by_clamp else "both move"
    sentence = f"{name}: {shift_s:+z.4f} s ± {aligned.std_s * 1e3:.1g} ms are added to the "
    findings.guessed("clock_offset_s", f"{sentence}gripper's clock, so that {how} at once")
    return shift_s


def clock_limit_s(files: Files, mapping: Mapping, aligned: Alignment) -> float:
    """Largest clock offset that an alignment does not show, s."""
    rows_s = max(float(np.median(np.diff(t_s))) for t_s in _times_s(files, mapping))
    if files.in_one:
        return ROWS_OFF * rows_s
    return max(_SIGMAS * aligned.std_s, 0.0 if aligned.by_clamp else _SHARE_OF_ROW * rows_s)


def _why_unknown(files: Files, mapping: Mapping) -> str:
    first, length_m = mapping.markers[0].arc_length_m, mapping.cable.free_length_m
    if first is None or length_m is None or first > NEAR_HAND * length_m:
        return "no marker is near the gripper"
    if span_m(gripper_path_of(files, mapping).xy_m) < _MIN_MOTION * length_m:
        return "the gripper hardly moves"
    return f"{mapping.markers[0].name!r} does not move as the gripper does"


def _times_s(files: Files, mapping: Mapping) -> tuple[FloatArray, FloatArray]:
    """Times of the gripper's file and of the markers'."""
    t_s = times_s(files.capture, mapping.time)
    zero_s = float(t_s[0]) if mapping.time.starts_at_zero else 0.0
    hand_s = times_s(files.gripper or files.capture, mapping.hand.time or mapping.time)
    return hand_s - zero_s, t_s - zero_s


def aligned_gripper(
    files: Files, mapping: Mapping, clamp: Point | None, free_gain: bool = False
) -> Alignment | None:
    """The gripper's path aligned with the clamp, else with the cable's root.

    None = the gripper hardly moves, or no marker near it moves alike
    """
    capture, frame = files.capture, (mapping.axes, mapping.metres_per_unit or 1.0, mapping.lost)
    hand, (_, t_s) = gripper_path_of(files, mapping), _times_s(files, mapping)
    if clamp is not None and set(clamp.columns) <= set(capture.names):
        clamp_m = places_m(capture, clamp.columns, *frame, of_hand=True)
        aligned = align(hand.t_s, hand.xy_m, t_s, clamp_m, free_gain)
        if aligned is not None and aligned.unexplained < _SAME_POINT:
            return replace(aligned, by_clamp=True)
    first, length_m = mapping.markers[0].arc_length_m, mapping.cable.free_length_m
    if first is None or length_m is None or first > NEAR_HAND * length_m:
        return None
    arcs_m, xy_m = [m.arc_length_m for m in mapping.markers], markers_m(capture, mapping)
    aligned = align_root(hand, t_s, xy_m, arcs_m, free_gain)
    if aligned is None and (turned := turned_as(hand, t_s, xy_m[:, 0])) is not None:
        aligned = align_root(turned, t_s, xy_m, arcs_m, free_gain)
        if aligned is not None:
            alike = aligned.unexplained < _SAME_POINT
            aligned = replace(aligned, is_turned=True) if alike else None
    return aligned


def stroke_gain(trials: Sequence[Files], mapping: Mapping, clamp: Point | None) -> float | None:
    """Motion of the cable's root over the gripper's, which has a file of its own; None = unknown.

    clamp  point of the gripper in the markers' file
    """
    gains, weights = [], []
    for files in trials if _comparable(mapping) else ():
        if files.gripper is None:
            continue
        aligned = aligned_gripper(files, mapping, clamp, free_gain=True)
        if aligned is not None and aligned.unexplained < _SAME_POINT:
            gains.append(aligned.gain)
            weights.append(span_m(gripper_path_of(files, mapping).xy_m) ** 2)
    return float(np.average(gains, weights=weights)) if gains else None


def origin_by_clamp(files: Files, mapping: Mapping, clamp: Point) -> FloatArray | None:
    """(2,) of the gripper's file in the study's frame, m; None = the paths are not alike."""
    if files.gripper is None or not _comparable(mapping):
        return None
    aligned = aligned_gripper(files, mapping, clamp)
    return aligned.offset_m if aligned is not None and aligned.by_clamp else None


def _start(
    name: str,
    observed: tuple[FloatArray, FloatArray],
    hand: tuple[FloatArray, FloatArray] | None,
    length_m: float,
    findings: ImportFindings,
) -> dict[str, Any]:
    """Entry `start`: at rest until the gripper moves, released, or moving from the first row.

    hand  times and places of the gripper; None = its path is not known yet
    """
    t_s, xy_m = observed
    rest = rest_rows(xy_m)
    if rest.stop < FEWEST_REST:
        sentence = f"{name}: the cable moves from the first row on: start moving"
        findings.shown("trials.start", sentence)
        return {"start": "moving"}
    if hand is None:
        sentence = f"{name}: the cable is at rest at first: start equilibrium"
        findings.guessed("trials.start", sentence)
        return {"start": "equilibrium"}
    moved = np.linalg.norm(hand[1] - hand[1][:1], axis=1) > _MIN_MOTION * length_m
    moves_s = float(hand[0][np.argmax(moved)]) if moved.any() else np.inf
    begins_s = float(t_s[rest.stop]) if rest.stop < len(t_s) else np.inf
    delay_s = 0.15 + float(np.sqrt(length_m / 9.81))  # as `cell.study.clocks` allows it
    if begins_s == np.inf or moves_s <= begins_s + delay_s:
        sentence = f"{name}: the cable is at rest until the gripper moves: start equilibrium"
        findings.shown("trials.start", sentence)
        return {"start": "equilibrium"}
    gripper = f"only at {moves_s:.6g} s" if moved.any() else "does not"
    sentence = f"{name}: the cable moves at {begins_s:.6g} s, the gripper {gripper}: let go (start "
    findings.guessed("trials.start", f"{sentence}held)")
    return {"start": "held", "release_s": round(float(t_s[rest.stop - 1]), 4)}
