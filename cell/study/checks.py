"""The checks of a study's data, as one table: question, statistic, limit, remedy.

A check that is `refused` says what no cable does: the study is not read.  One that is `noted` says
what only a rare cable does, or what makes a fit weak: the reader decides.  `cell look`, the preview
of `cell import`, every command that reads a study, and the reference in docs print these rows.

The statistics are functions: of frame, reach and clock in `plausible`, of a record in `facts`, of a
force in `wrench`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Cable
from cell.files.input_error import Problem
from cell.study import facts, plausible, tracks, wrench
from cell.study.check import DataCheck, failures
from cell.study.clocks import GAP_S, GAP_STEPS, WITHIN, WITHIN_S
from cell.study.data import Trial, WrenchSensor
from cell.study.facts import TrialFacts, TrialRecord
from cell.study.plausible import TrialEvidence
from cell.study.table import MAX_TRIAL_S

_CLOCK_LIMIT = f"{WITHIN_S:g} s or {WITHIN:g} √(L/g), and two frames"
_LOG_LIMIT = f"{GAP_S:g} s or {GAP_STEPS:g} usual steps"

LOG_GAP = DataCheck(
    "log_gap",
    "Is the gripper's log whole while it moves?",
    "longest step within which the gripper moves, s",
    _LOG_LIMIT,
    "refused",
    "the gripper is not seen from {from_s:.6g} to {to_s:.6g} s, limit {limit_s:.2g} s while it "
    "moves: {moved_mm:.3g} mm and {turned_rad:.2g} rad in between;",
    "log the whole motion, or cut the trial before it or after it",
    plausible.log_gap,
)
LOG_ENDS = DataCheck(
    "log_ends",
    "Does the gripper rest where its log ends?",
    "time in which markers are seen after it, s",
    _LOG_LIMIT,
    "refused",
    "the log ends at {log_s:.6g} s, while the gripper moves at {speed:.2g} {unit}/s, yet the "
    "markers are seen until {film_s:.6g} s;",
    "log the gripper until it rests, or cut the frames after the log's end",
    plausible.log_ends,
)
LOG_BEGINS = DataCheck(
    "log_begins",
    "Does the gripper rest where its log begins?",
    "time in which markers are seen before it, s",
    _LOG_LIMIT,
    "refused",
    "the log begins at {log_s:.6g} s, while the gripper moves at {speed:.2g} {unit}/s, yet the "
    "markers are seen from {film_s:.6g} s on;",
    "log the gripper from its rest on, or cut the frames before the log's beginning and give "
    "`start: moving`",
    plausible.log_begins,
)
HAND_UNIT = DataCheck(
    "hand_unit",
    "Is the gripper given in metres, as its markers are?",
    "span of the gripper's places over that of markers and cable",
    f"{plausible.OTHER_UNIT:g}",
    "refused",
    "the gripper's places are up to {hand_m:.3g} m apart, those of the markers {reach_m:.3g} m;",
    "give metres, not millimetres",
    plausible.hand_unit,
)
CABLE_WAITS = DataCheck(
    "cable_waits",
    "Does the cable move soon after its gripper?",
    "time from the gripper's first motion to the cable's, s",
    _CLOCK_LIMIT,
    "refused",
    "the cable rests until {cable_s:.3g} s, yet its gripper moves at {hand_s:.3g} s, and no cable "
    "waits so long: the clocks differ by {late_s:.2g} s;",
    "subtract this from t_s of markers.csv",
    plausible.cable_waits,
)
CABLE_AHEAD = DataCheck(
    "cable_ahead",
    "Does the cable rest until its gripper moves?",
    "time from the cable's first motion to the gripper's, s",
    f"{_CLOCK_LIMIT}; refused if a marker is too far from the gripper too",
    "noted",
    "the cable moves at {cable_s:.3g} s, its gripper only at {hand_s:.3g} s; if both are one "
    "motion the clocks differ:",
    "add {late_s:.2g} s to t_s of markers.csv; if the cable was let go, give `start: held` with "
    "release_s: {cable_s:.3g} in study.yaml",
    plausible.cable_ahead,
)
OUT_OF_REACH = DataCheck(
    "out_of_reach",
    "Is every marker within the gripper's reach?",
    "largest distance of a marker from the gripping point, free lengths",
    f"{plausible.FARTHEST:g}",
    "refused",
    "{x_m:g} lies more than {limit_m:g} m "
    f"({plausible.FARTHEST:g} free lengths) from the gripping point;",
    "give metres, in the frame of grip.csv",
    plausible.out_of_reach,
)
EXCHANGED = DataCheck(
    "exchanged",
    "Does every marker go on where it was?",
    "distance to its own place over that to another's",
    f"{tracks.NEARER:g}, for both of two markers",
    "refused",
    "{first} is where {second} was in the row before, and {second} where {first} was{more};",
    "exchange the columns of the two in the rows from here to line {last}",
    plausible.exchanged,
)
BOTH_ENDS_HELD = DataCheck(
    "both_ends_held",
    "Is the tip free?",
    "span of the outermost marker over that of what moves",
    f"{plausible.HELD_STAYS:g}",
    "refused",
    "the marker at arc length {arc_m:g} m stays within {tip_mm:.2g} mm while {what} by "
    "{most_mm:.3g} mm: both ends of this cable are held, and only a cable with a free tip can be "
    "modelled;",
    "let the tip go",
    plausible.both_ends_held,
)
FROZEN = DataCheck(
    "frozen_marker",
    "Does no marker stay exactly in place while the cable moves?",
    "rows in which it stays",
    f"{tracks.FROZEN_ROWS}, while another moves by {plausible.MOVES_SHARE:g} free lengths",
    "refused",
    "the marker at arc length {arc_m:g} m stays at ({x_m:g}, {y_m:g}) m up to line {last}, while "
    "the cable moves by {moved_mm:.3g} mm: it was lost;",
    "leave its values empty there",
    plausible.frozen_marker,
)
REVERSED = DataCheck(
    "reversed_arcs",
    "Are arc lengths counted from the gripping point?",
    "distance of a marker from the gripper beyond its arc length, free lengths",
    f"{plausible.SLACK:g}, but not if counted from the other end",
    "refused",
    "the marker at arc length {arc_m:g} m is {away_m:.3g} m from the gripping point, farther than "
    "any cable lets it;",
    "the markers fit when counted from the other end: turn markers.arc_length_m round",
    plausible.reversed_arcs,
)
TOO_FAR = replace(
    REVERSED,
    name="too_far",
    question="Is no marker farther from the gripper than its arc length?",
    limit=f"{plausible.SLACK:g}",
    remedy="check arc_length_m, the metres of both files, and that both have the same frame",
    failure=plausible.too_far,
)
WRONG_SIDE = DataCheck(
    "wrong_side",
    "Does the cable leave the clamp to the side of its angle?",
    "place of a resting marker behind the clamp, free lengths",
    f"{plausible.SLACK:g}",
    "refused",
    "at rest the marker at arc length {arc_m:g} m is {beyond_m:.3g} m {side} of the gripping "
    "point; with angle_rad = {angle_rad:g} the cable leaves it to the other side:",
    "change the sign of x_m in both files, or give the clamp angle as π − angle",
    plausible.wrong_side,
)
FRAME_RATE = DataCheck(
    "frame_rate",
    "Are there frames enough to see the slowest swing?",
    "usual step of time over the period 2π √(L/g)",
    "0.5",
    "refused",
    "frames are {step_s:.3g} s apart, yet a cable of {length_m:g} m swings to and fro within "
    "{slowest_s:.2g} s;",
    "give t_s in seconds, with several frames per swing",
    plausible.frame_rate,
)
RISES = DataCheck(
    "rises",
    "Does the cable droop at rest?",
    "height of the tip above the clamp's direction, free lengths",
    f"{plausible.SLACK:g}",
    "noted",
    "at rest the cable rises {lift_mm:.3g} mm above the clamp's direction, against gravity;",
    "unless it is naturally curved, check the signs of y_m (up), angle_rad (positive = pointing "
    "down) and gravity_m_per_s2",
    plausible.rises,
)
MOVES_FIRST = DataCheck(
    "moves_first",
    "Is a cable that begins in equilibrium at rest?",
    "way of a marker before the gripper moves, free lengths",
    f"{plausible.MOVES:g}",
    "noted",
    "before the gripper moves the cable does, by {reach_mm:.3g} mm, yet it is said to begin in "
    "equilibrium;",
    "give {meant} in study.yaml",
    plausible.moves_first,
)
#: Of every trial; the first that fails is told.
TRIAL_REFUSALS = (
    HAND_UNIT,
    CABLE_WAITS,
    replace(CABLE_AHEAD, failure=plausible.cable_ahead_and_far),
    OUT_OF_REACH,
    EXCHANGED,
    BOTH_ENDS_HELD,
    FROZEN,
    replace(CABLE_AHEAD, failure=plausible.cable_ahead_and_too_far),
    REVERSED,
    TOO_FAR,
    WRONG_SIDE,
    FRAME_RATE,
)
TRIAL_NOTES = (RISES, CABLE_AHEAD, MOVES_FIRST)

#: Of a trial that is imported, before those of every trial; all that fail are told.
IMPORT_REFUSALS = (
    DataCheck(
        "too_long",
        "Is it one motion and its swing?",
        "time from the first row to the last, s",
        f"{MAX_TRIAL_S:g}",
        "refused",
        f"is {{lasts_s:.4g}} s after the first row, limit {MAX_TRIAL_S:g} s;",
        "correct time.seconds_per_unit of the mapping, or cut the file to one motion and its swing",
        plausible.too_long,
    ),
    LOG_GAP,
    LOG_ENDS,
    LOG_BEGINS,
    DataCheck(
        "same_marker",
        "Is every marker another one?",
        "rows in which two markers differ",
        "0",
        "refused",
        "{first!r} and {second!r} have the same places in all {rows} rows that show both;",
        "remove one from markers",
        plausible.same_marker,
    ),
    DataCheck(
        "not_on_cable",
        "Does every marker move?",
        "span of a marker over the largest of all",
        f"{plausible.STAYS:g}, while the gripper moves",
        "refused",
        "{name!r} moves by {moved_mm:.2g} mm in all rows, the gripper by {hand_mm:.3g} mm: it is "
        "not on the cable;",
        "remove it from markers",
        plausible.not_on_cable,
    ),
)
#: The same if none of these fails; the first that fails is told.
IMPORT_SHAPE = (
    DataCheck(
        "hand_scale",
        "Is the gripper in the unit of the markers?",
        "span of the marker next to the hand over that of the gripper",
        f"{plausible.TIMES_FARTHER:g} or its inverse, where both move alike",
        "refused",
        "the gripper moves by {hand_m:.3g} m, and {name!r} next to it as it does by {marker_m:.3g} "
        "m: its unit is another one;",
        "correct metres_per_unit of hand in the mapping",
        plausible.hand_scale,
    ),
    EXCHANGED,
    DataCheck(
        "longer_than_cable",
        "Are two markers as near as the cable between them is long?",
        "share of the rows in which they are, by a tenth of the free length",
        f"{plausible.MOST_SLIPS:g}",
        "refused",
        "{first!r} and {second!r} are {apart_m:.4g} m apart, with {between_m:.4g} m of cable "
        "between them, limit {limit_m:.4g} m, as in {share:.0%} of the rows: a marker jumps or is "
        "named wrongly;",
        "correct the columns or arc_length_m of the two in the mapping",
        plausible.longer_than_cable,
    ),
    DataCheck(
        "out_of_plane",
        "Does the cable move in one plane?",
        "distance of a marker from the plane of all, free lengths",
        f"{plausible.REFUSED_ACROSS:g} in {plausible.MOST_SLIPS:g} of the rows",
        "refused",
        "the cable is {away_mm:.3g} mm out of the plane, limit {limit_mm:.3g} mm;",
        "correct `axes` in the mapping, or move the gripper within one plane",
        plausible.out_of_plane,
    ),
)
IMPORT_NOTES = (
    DataCheck(
        "wide",
        "Is the motion flat enough for a model in one plane?",
        "rms distance of markers from the plane, free lengths",
        f"{plausible.NOTED_ACROSS:g}",
        "noted",
        "the cable is {rms_mm:.3g} mm rms out of the plane; the model moves within it",
        "",
        plausible.wide,
    ),
    DataCheck(
        "held_rows",
        "Does no tracker repeat what it had lost?",
        "rows that repeat the row before, then jump",
        f"{tracks.HELD_ROWS}",
        "noted",
        "{rows} rows from here repeat the row before, then the cable jumps;",
        "empty them if the tracker held what it had lost",
        plausible.held,
    ),
)

_FORCE = "is {factor:.2g} times what moves cable and tool as gripper and markers show, limit"
_OF_FORCE = "twice integrated force over that of the masses by hand and markers"
FORCE_REVERSED = DataCheck(
    "force_reversed",
    "Does the force point as that which moves the cable?",
    _OF_FORCE,
    f"0; {wrench.FORCE_REFUSED[0]:.2g} is refused",
    "noted",
    _FORCE + " {limit:.2g}: it points the other way;",
    "give the force that gripper and clamp exert on the cable, which at rest points up",
    partial(wrench.force_reversed, limit=0.0),
)
FORCE_LARGE = DataCheck(
    "force_large",
    "Is the force no larger than what moves the masses?",
    _OF_FORCE,
    f"{wrench.FORCE_NOTED[1]:g}; {wrench.FORCE_REFUSED[1]:g} is refused",
    "noted",
    _FORCE + " {limit:g};",
    "give N, not mN, and the mass that the sensor carries as wrench.tool in study.yaml",
    partial(wrench.force_above, limit=wrench.FORCE_NOTED[1]),
)
FORCE_SMALL = DataCheck(
    "force_small",
    "Is the force no smaller than what moves the masses?",
    _OF_FORCE,
    f"{wrench.FORCE_NOTED[0]:g}",
    "noted",
    _FORCE + " {limit:g};",
    "see whether it is in N, on the clock of grip.csv, and whether wrench.tool and the cable's "
    "line density are right",
    partial(wrench.force_below, limit=wrench.FORCE_NOTED[0]),
)
#: Of the wrench of every trial.
FORCE_REFUSALS = (
    replace(
        FORCE_REVERSED,
        failure=partial(wrench.force_reversed, limit=wrench.FORCE_REFUSED[0]),
    ),
    replace(FORCE_LARGE, failure=partial(wrench.force_above, limit=wrench.FORCE_REFUSED[1])),
)
FORCE_NOTES = (FORCE_REVERSED, FORCE_LARGE, FORCE_SMALL)

#: Of the record of every trial; all that fail are told, of trials with the same sentence at once.
NEVER_MOVES = DataCheck(
    "never_moves",
    "Does the gripper move, or is the cable let go?",
    "motion of the gripper",
    "none",
    "noted",
    "the gripper never moves, and the cable is not let go;",
    "record a motion",
    facts.never_moves,
)
RECORD_NOTES = (
    NEVER_MOVES,
    DataCheck(
        "rest_frames",
        "Is the noise known from frames at rest, if it is not stated?",
        "frames at rest",
        f"{facts.REST_FRAMES}",
        "noted",
        "{shown} the cable at rest;",
        f"record {facts.REST_FRAMES} or more before the motion, for the noise is known from these",
        facts.few_at_rest,
    ),
    DataCheck(
        "lost_values",
        "Are most values seen?",
        "share of the values that are seen",
        f"{facts.LEAST_SEEN:g}",
        "noted",
        "{seen:.0%} of the values were seen;",
        "see which markers are lost when",
        facts.lost_values,
    ),
    DataCheck(
        "uneven_steps",
        "Are the steps of time even?",
        "share of the steps that are a fifth off the usual one",
        f"{facts.MOST_UNEVEN:g}",
        "noted",
        "{irregular:.0%} of the steps of time are uneven;",
        "are frames missing?",
        facts.uneven_steps,
    ),
    DataCheck(
        "small_motion",
        "Is the motion larger than the noise?",
        "span of the tip over the noise",
        f"{facts.SPAN_OF_NOISE:g}",
        "noted",
        "the tip moves by {tip_mm:.2g} mm, only {times:.2g} times the noise;",
        "move the gripper farther or faster",
        facts.small_motion,
    ),
    DataCheck(
        "root_away",
        "Does the cable begin at the gripping point?",
        "distance of the curve through the resting markers from it, lengths",
        f"{facts.ROOT_AWAY:g}",
        "noted",
        "at rest the curve through the markers begins {away_mm:.2g} mm from the gripping point, "
        "limit {limit_mm:.2g} mm;",
        "check the gripper's place, arc lengths and both frames",
        facts.root_away,
    ),
    DataCheck(
        "off_curve",
        "Do the markers lie on a smooth curve at rest?",
        "largest distance of a marker from it, lengths",
        f"{facts.OFF_CURVE:g}",
        "noted",
        "at rest the marker at arc length {arc_m:g} m is {off_mm:.2g} mm from a smooth curve, "
        "limit {limit_mm:.2g} mm;",
        "check its arc length and the order of markers",
        facts.off_curve,
    ),
    DataCheck(
        "root_turned",
        "Does the cable leave the clamp along its angle?",
        "angle between both at rest, degrees",
        f"{np.degrees(facts.ROOT_TURNED_RAD):.0f}",
        "noted",
        "at rest the cable leaves the clamp {turned_deg:+z.0f}° from its angle, limit "
        f"{np.degrees(facts.ROOT_TURNED_RAD):.0f}°;",
        "check angle_rad (positive = pointing down) and the axes",
        facts.root_turned,
    ),
    DataCheck(
        "moves_at_end",
        "Is a swing recorded after the motion?",
        "time from the gripper's stop to the last frame, s",
        "0",
        "noted",
        "the gripper still moves when the record of the markers ends;",
        "record the swing too",
        facts.moves_at_end,
    ),
    DataCheck(
        "no_swing",
        "Does the record show a swing?",
        "swings and frames after the gripper's stop",
        f"{facts.FEWEST_SWINGS:g} and {facts.FEWEST_FRAMES}",
        "noted",
        "the record ends {after_s:.2g} s after the gripper stops, too soon to show a swing",
        "",
        facts.no_swing,
    ),
    DataCheck(
        "slow_swing",
        "Is the swing no slower than a hanging chain's?",
        "its frequency over 1.2 √(g/L) / 2π",
        f"{facts.OF_CHAIN:g}",
        "noted",
        "the cable swings at {hz:.3g} Hz, and none of its length is slower than {slowest_hz:.3g} "
        "Hz;",
        "check the units of time and length",
        facts.slow_swing,
    ),
    DataCheck(
        "droop",
        "Is the swing as fast as the droop says?",
        "its frequency over √(1.545 g/δ) / 2π",
        f"{facts.OF_DROOP:g} or its inverse",
        "noted",
        "the cable swings at {hz:.3g} Hz, yet one that its weight bends by {droop_mm:.3g} mm "
        "swings at about {droops_hz:.3g} Hz;",
        "check the units of time and length, unless it is naturally curved",
        facts.unlike_droop,
    ),
    DataCheck(
        "few_per_swing",
        "Are there frames enough in a swing?",
        "frames in a swing",
        f"{facts.FRAMES_PER_SWING:.0f}",
        "noted",
        "{rate_hz:.3g} frames a second are {times:.2g} in a swing of {hz:.3g} Hz;",
        f"{facts.FRAMES_PER_SWING:.0f} or more are needed",
        facts.few_per_swing,
    ),
    DataCheck(
        "few_swings",
        "Is the swing recorded long enough for its damping?",
        "swings after the gripper's stop",
        f"{facts.DAMPING_SWINGS:.0f}",
        "noted",
        "the record ends {after_s:.2g} s after the gripper stops, {swings:.2g} swings of "
        "{hz:.3g} Hz;",
        f"{facts.DAMPING_SWINGS:.0f} or more show the damping",
        facts.few_swings,
    ),
)
#: Of all trials of a study together.
STATED_NOISE = DataCheck(
    "stated_noise",
    "Is the stated noise that of the frames at rest?",
    "noise_std_m over the noise from frame to frame",
    f"{facts.STATED_NOISE[0]:.2g} to {facts.STATED_NOISE[1]:g}",
    "noted",
    "noise_std_m states {stated_mm:.2g} mm, the frames at rest show {shown_mm:.2g} mm: {what};",
    "correct it, or leave it out",
    facts.stated_noise,
)
STUDY_NOTES = (
    STATED_NOISE,
    DataCheck(
        "frequencies",
        "Do all trials swing alike?",
        "difference of the strongest frequencies over the lowest",
        f"{facts.FREQUENCY:g}, and the resolution of both",
        "noted",
        "the strongest swing has {low_hz:.3g} Hz in {low} and {high_hz:.3g} Hz in {high}:",
        "are they of one cable, held at the same place?",
        facts.frequencies_differ,
    ),
)
_GROUPS: tuple[tuple[DataCheck[Any], ...], ...] = (
    *(IMPORT_REFUSALS, IMPORT_SHAPE, TRIAL_REFUSALS, TRIAL_NOTES, IMPORT_NOTES),
    *(FORCE_NOTES, RECORD_NOTES, STUDY_NOTES),
)
#: All of the above, each once.
CHECKS = tuple({check.name: check for group in _GROUPS for check in group}.values())


def trial_problems(
    trial: Trial, cable: Cable, arc_length_m: FloatArray, gravity_m_per_s2: tuple[float, float]
) -> tuple[list[Problem], list[str]]:
    """What of a trial is refused, and what is odd and yet possible, each with its line.

    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    """
    evidence = TrialEvidence(trial, cable, arc_length_m, gravity_m_per_s2)
    file, line = evidence.source.file, trial.markers.line
    for found, sentence in failures(TRIAL_REFUSALS, evidence):
        place = (file.with_name(found.table), 2) if found.table else (file, line(found.row or 0))
        return [Problem(*place, None, found.column, sentence)], []
    for found, sentence in failures(TRIAL_NOTES, evidence):
        where = "" if found.row is None else f"line {line(found.row)}: "
        return [], [f"{file}: {where}{sentence}"]
    return [], []


def force_problems(
    trial: Trial, cable: Cable, outermost_m: float, sensor: WrenchSensor, file: Path
) -> tuple[list[Problem], list[str]]:
    """The same of its wrench.

    outermost_m  arc length of the outermost marker
    """
    force = wrench.force_factor(trial, cable, outermost_m, sensor)
    if force is None:
        return [], []
    for _, sentence in failures(FORCE_REFUSALS, force):
        return [Problem(file, 2, None, force.column, sentence)], []
    return [], [f"{file}: {force.column} {s}" for _, s in failures(FORCE_NOTES, force)]


def oddities(all_facts: Sequence[TrialFacts], noise_std_m: float | None) -> list[str]:
    """What should be better, of every trial and of all together.

    noise_std_m  that the study states; None = it states none
    """
    of_trials: dict[str, list[str]] = {}
    for each in all_facts:
        record = TrialRecord(each, noise_std_m)
        # Of a cable that nothing moves a swing is of no interest.
        checks = (NEVER_MOVES,) if record.shows_nothing else RECORD_NOTES
        for _, sentence in failures(checks, record):
            of_trials.setdefault(sentence, []).append(each.name)
    found = [f"{_listed(names)}: {sentence}" for sentence, names in of_trials.items()]
    return [*found, *(s for _, s in failures(STUDY_NOTES, (all_facts, noise_std_m)))]


def stated_oddly(all_facts: Sequence[TrialFacts], noise_std_m: float | None) -> str | None:
    """That the noise of a study is stated much larger, or smaller, than it is at rest."""
    return next((s for _, s in failures([STATED_NOISE], (all_facts, noise_std_m))), None)


#: Trials that are named in a sentence.
NAMED = 3


def _listed(names: Sequence[str]) -> str:
    """Names of trials, not all of many."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
