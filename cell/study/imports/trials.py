"""The files of the trials, and their entries in the proposed mapping: start, role, clock, rate."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, Finding, Sure
from cell.study.imports.contents import contents
from cell.study.imports.convert import times_s
from cell.study.imports.gripper_section import TextSection, TimeSection
from cell.study.imports.mapping import Mapping, TrialEntry
from cell.study.imports.places import places_m
from cell.study.imports.scales import time_section
from cell.study.imports.shape import FEWEST_REST, rest_rows
from cell.study.series import span_m


@dataclass(frozen=True)
class Files:
    """A trial's files as the mapping names them, and what they hold."""

    name: str
    file: str
    capture: Capture
    gripper_file: str | None = None
    gripper: Capture | None = None


def trial_names(files: Sequence[Path]) -> list[str]:
    """Unique names of trials, from the names of their files."""
    names: list[str] = []
    for file in files:
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", file.stem).strip("_.-") or "trial"
        number = 2
        unique = name
        while unique in names:
            unique, number = f"{name}_{number}", number + 1
        names.append(unique)
    return names


def trial_entries(
    trials: Sequence[Files], mapping: Mapping, rate_hz: float | None
) -> tuple[list[TrialEntry], list[Finding]]:
    """Start, role and clock of every trial, and what its files have of their own.

    rate_hz  rows a second that somebody stated for all files of markers
    raises   InputError: times are in disorder, or a column is missing
    """
    entries: list[TrialEntry] = []
    findings: list[Finding] = []
    for number, (files, entry) in enumerate(zip(trials, mapping.trials, strict=True)):
        role = "validate" if len(trials) > 1 and number == len(trials) - 1 else "fit"
        own, told = _own(files, mapping, rate_hz)
        findings += told
        entry = entry.model_copy(update={"role": role, **own})
        of_trial = mapping.of_trial(entry)
        if of_trial.time.seconds_per_unit is None or mapping.metres_per_unit is None:
            entries.append(entry)
            continue
        begun, told = start_of(files.name, files.capture, files.gripper, of_trial)
        entry = entry.model_copy(update=begun)
        entries.append(entry)
        findings += told
    if len(trials) > 1:
        sentence = (
            f"{trials[-1].name} is kept for comparison (role validate), the others are fitted"
        )
        findings.append(Finding("trials", sentence, Sure.GUESSED))
    return entries, findings


def _own(
    files: Files, mapping: Mapping, rate_hz: float | None
) -> tuple[dict[str, Any], list[Finding]]:
    """Entries of a trial in which its files differ from the first trial's."""
    hand = mapping.hand
    own: dict[str, Any] = {}
    findings: list[Finding] = []
    both = [("", files.capture, mapping.text, mapping.time, rate_hz)]
    if files.gripper is not None:
        both.append(("hand_", files.gripper, hand.text, hand.time or mapping.time, None))
    for prefix, capture, text, time, stated_hz in both:
        form = TextSection.of(capture)
        if form != text and form is not None:
            own[f"{prefix}text"] = form
            sentence = f"{capture.path.name}: cells are separated by {form.separator!r}, "
            sentence += f"the decimal mark is {form.decimal!r}"
            findings.append(Finding("trials.text", sentence, Sure.SEEN))
        unit, told = _seconds_per_unit(capture, time, stated_hz)
        findings += told
        if unit is not None:
            own[f"{prefix}seconds_per_unit"] = unit
    return own, findings


def _seconds_per_unit(
    capture: Capture, section: TimeSection, rate_hz: float | None
) -> tuple[float | None, list[Finding]]:
    """Seconds a unit of a file's times that it states otherwise than the first file does."""
    own, (found,) = time_section(capture, contents(capture), rate_hz)
    unit, of_first = own.seconds_per_unit, section.seconds_per_unit
    if own.column != section.column or unit == of_first:
        return None, []
    entry = "trials.seconds_per_unit"
    if found.sure is Sure.SAID and unit is not None:
        return unit, [Finding(entry, f"{capture.path.name}: {found.sentence}", Sure.SAID)]
    if found.sure is Sure.WANTED and of_first is not None:
        sentence = f"{capture.path.name} states no rate: it is taken as that of the first trial, "
        sentence += f"{1.0 / of_first:g} rows a second"
        return None, [Finding(entry, sentence, Sure.GUESSED)]
    return None, []


#: A clock is proposed to be off if it is so by more than this many rows.
ROWS_OFF = 1.5
#: The first marker follows the gripper closely if it is within this share of the cable.
NEAR_HAND = 0.35
#: A gripper moves if it leaves its place by this share of the cable's length.
_MOVES = 0.01


def start_of(
    name: str, capture: Capture, hand: Capture | None, mapping: Mapping
) -> tuple[dict[str, Any], list[Finding]]:
    """Entries `start`, `release_s` and `clock_offset_s` of a trial, and why.

    raises  InputError: times are in disorder, or a column is missing
    """
    scale = mapping.metres_per_unit or 1.0
    t_s = times_s(capture, mapping.time)
    zero_s = float(t_s[0]) if mapping.time.starts_at_zero else 0.0
    t_s = t_s - zero_s
    xy_m = np.stack(
        [places_m(capture, m.columns, mapping.axes, scale, mapping.lost) for m in mapping.markers],
        axis=1,
    )
    begun: dict[str, Any] = {}
    findings: list[Finding] = []
    hand_s, hand_m = t_s, np.zeros((len(t_s), 2))
    known = mapping.hand.columns is not None or mapping.hand.fixed_m is not None
    if known:
        hand_s, hand_m = _gripper_path(capture, hand, mapping, zero_s)
    elif hand is not None:
        sentence = f"{name}: whether both clocks agree is not known before the gripper's path is"
        findings.append(Finding("clock_offset_s", sentence, Sure.GUESSED))
    if known and hand is not None:
        begun, findings = _by_rows(name, capture, t_s, hand_s)
        if not begun:
            begun, findings = _clock(name, (hand_s, hand_m), (t_s, xy_m), mapping)
        hand_s = hand_s + begun.get("clock_offset_s", 0.0)
    seen = np.isfinite(xy_m).any(axis=(1, 2))
    length_m = mapping.cable.free_length_m or 1.0
    of_hand = (hand_s, hand_m) if known else None
    more, told = _start(name, (t_s[seen], xy_m[seen]), of_hand, length_m)
    return begun | more, [*findings, *told]


def _gripper_path(
    capture: Capture, hand: Capture | None, mapping: Mapping, zero_s: float
) -> tuple[FloatArray, FloatArray]:
    """Times and places of the gripping point."""
    section, of = mapping.hand, hand or capture
    t_s = times_s(of, section.time or mapping.time) - zero_s
    if section.columns is None:
        return t_s, np.broadcast_to(np.array(section.fixed_m, dtype=np.float64), (len(t_s), 2))
    scale = section.metres_per_unit or mapping.metres_per_unit or 1.0
    axes = section.axes or mapping.axes
    at_m = places_m(of, section.columns, axes, scale, mapping.lost, unseen=0.0, of_hand=True)
    known = np.isfinite(at_m).all(axis=1)
    return t_s[known], at_m[known]


def _by_rows(
    name: str, capture: Capture, t_s: FloatArray, hand_s: FloatArray
) -> tuple[dict[str, Any], list[Finding]]:
    """The offset to a clock that counts frames, of which programs call the first 0 or 1."""
    late_s = float(t_s[0] - hand_s[0])
    step_s = float(np.median(np.diff(t_s)))
    together = len(t_s) == len(hand_s) and np.allclose(t_s - late_s, hand_s, atol=0.1 * step_s)
    if capture.counted != "frame" or not together or not 0.0 < abs(late_s) < ROWS_OFF * step_s:
        return {}, []
    late_s = round(late_s, 6)
    sentence = (
        f"{name}: gripper and markers have {len(t_s)} rows at one rate and are taken row by row: "
        f"{late_s:+g} s are added to the gripper's clock"
    )
    return {"clock_offset_s": late_s}, [Finding("clock_offset_s", sentence, Sure.GUESSED)]


def _clock(
    name: str,
    hand: tuple[FloatArray, FloatArray],
    seen: tuple[FloatArray, FloatArray],
    mapping: Mapping,
) -> tuple[dict[str, Any], list[Finding]]:
    """The offset of the gripper's clock, where a marker near it tells one."""
    first, length_m = mapping.markers[0].arc_length_m, mapping.cable.free_length_m
    if first is None or length_m is None or first > NEAR_HAND * length_m:
        sentence = f"{name}: no marker is near the gripper: whether both clocks agree is not known"
        return {}, [Finding("clock_offset_s", sentence, Sure.GUESSED)]
    shift_s = clock_shift_s(*hand, seen[0], seen[1][:, 0])
    if shift_s is None:
        sentence = f"{name}: the gripper hardly moves: whether both clocks agree is not known"
        return {}, [Finding("clock_offset_s", sentence, Sure.GUESSED)]
    limit_s = ROWS_OFF * float(max(np.median(np.diff(hand[0])), np.median(np.diff(seen[0]))))
    if abs(shift_s) <= limit_s:
        sentence = f"{name}: both clocks agree within {limit_s * 1e3:.3g} ms"
        return {}, [Finding("clock_offset_s", sentence, Sure.SEEN)]
    shift_s = round(shift_s, 4)
    sentence = f"{name}: {shift_s:+g} s are added to the gripper's clock, so that both move at once"
    return {"clock_offset_s": shift_s}, [Finding("clock_offset_s", sentence, Sure.GUESSED)]


def _start(
    name: str,
    seen: tuple[FloatArray, FloatArray],
    hand: tuple[FloatArray, FloatArray] | None,
    length_m: float,
) -> tuple[dict[str, Any], list[Finding]]:
    """At rest until the gripper moves, let go, or in motion from the first row on.

    hand  times and places of the gripper; None = its path is not known yet
    """
    t_s, xy_m = seen
    rest = rest_rows(xy_m)
    if rest.stop < FEWEST_REST:
        sentence = f"{name}: the cable moves from the first row on: start moving"
        return {"start": "moving"}, [Finding("trials.start", sentence, Sure.SEEN)]
    if hand is None:
        sentence = f"{name}: the cable is at rest at first: start equilibrium"
        return {"start": "equilibrium"}, [Finding("trials.start", sentence, Sure.GUESSED)]
    away = np.linalg.norm(hand[1] - hand[1][:1], axis=1) > _MOVES * length_m
    moves_s = float(hand[0][np.argmax(away)]) if away.any() else np.inf
    begins_s = float(t_s[rest.stop]) if rest.stop < len(t_s) else np.inf
    late_s = 0.15 + float(np.sqrt(length_m / 9.81))  # as `cell.study.clocks` allows it
    if begins_s == np.inf or moves_s <= begins_s + late_s:
        sentence = f"{name}: the cable is at rest until the gripper moves: start equilibrium"
        return {"start": "equilibrium"}, [Finding("trials.start", sentence, Sure.SEEN)]
    release_s = round(float(t_s[rest.stop - 1]), 4)
    sentence = (
        f"{name}: the cable moves at {begins_s:.3g} s, the gripper does not: let go (start held)"
    )
    return {"start": "held", "release_s": release_s}, [
        Finding("trials.start", sentence, Sure.GUESSED)
    ]


#: Shifts that are tried, and samples that each is tried on.
_SHIFTS, _SAMPLES = 1500, 600
#: Both must be known at once for this share of the shorter one.
_OVERLAP = 0.5
#: A gripper that moves by less than this share of what the marker moves tells no shift.
_MOVING = 0.1


def clock_shift_s(
    hand_s: FloatArray, hand_m: FloatArray, seen_s: FloatArray, seen_m: FloatArray
) -> float | None:
    """Offset of the gripper's clock by the motion of a marker near it, s; None = unknown.

    hand_m  (T, 2) path of the gripping point
    seen_m  (frames, 2) places of the marker nearest to it, nan = not seen
    """
    good = np.isfinite(seen_m).all(axis=1)
    seen_s, seen_m = seen_s[good], seen_m[good]
    reach = [span_m(m) if len(m) > 3 else 0.0 for m in (hand_m, seen_m)]
    if min(reach) == 0.0 or reach[0] < _MOVING * reach[1]:
        return None
    lasts_s = min(np.ptp(hand_s), np.ptp(seen_s))
    low = seen_s[0] - hand_s[-1] + _OVERLAP * lasts_s
    high = seen_s[-1] - hand_s[0] - _OVERLAP * lasts_s
    some = np.unique(np.linspace(0, len(seen_s) - 1, _SAMPLES).astype(int))
    at_s, at_m = seen_s[some], seen_m[some]

    def off(shift_s: float) -> float:
        there = (at_s >= hand_s[0] + shift_s) & (at_s <= hand_s[-1] + shift_s)
        if np.count_nonzero(there) < 4:
            return np.inf
        path = np.column_stack(
            [np.interp(at_s[there] - shift_s, hand_s, hand_m[:, k]) for k in range(2)]
        )
        return float(
            np.sum(np.var(at_m[there] - path, axis=0)) / np.sum(np.var(path, axis=0) + 1e-12)
        )

    tried = np.linspace(low, high, _SHIFTS)
    values = np.array([off(s) for s in tried])
    best = int(np.argmin(values))
    if not np.isfinite(values[best]) or values[best] > 0.5:
        return None
    step = tried[1] - tried[0]
    bounds = tried[best] - 2.0 * step, tried[best] + 2.0 * step
    return float(minimize_scalar(off, bounds=bounds, method="bounded", options={"xatol": 1e-5}).x)
