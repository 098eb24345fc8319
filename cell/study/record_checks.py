"""Checks of a trial's record for causes of a weak or wrong fit; they only warn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.files.words import counted, first_of
from cell.study.check import Failure, failures, noted
from cell.study.facts import FEWEST_FRAMES, FEWEST_SWINGS, TrialFacts

#: Trials that are named in a sentence.
NAMED = 24
#: In 384 trials of real and simulated cables the slowest swing had 0.44 to 1.67 times the frequency
#: expected from the droop, and all were faster than a hanging chain.
OF_DROOP, OF_CHAIN = 2.5, 0.8
#: Of 331 trials with any effects none begins at rest by this share of its length from its
#: gripping point, has a marker so far from a smooth curve, or leaves by this angle from the stated.
ROOT_AWAY, OFF_CURVE, ROOT_TURNED_RAD = 0.03, 0.015, np.radians(20.0)
#: In 363 trials of simulated cables with all effects, the root's motion differs from the gripper's
#: by less than this share of it, except where camera_scale or camera_roll acts.  The directions in
#: which a cable leaves the clamp differ by up to 7° between its trials.
ROOT_MOTION_ERROR, ROOTS_APART_RAD = 0.015, np.radians(10.0)
#: Frames at rest from which a noise level is estimated to a fifth, with two coordinates.
REST_FRAMES = 12
#: Frames of a swing below which its shape is lost between them.
FRAMES_PER_SWING = 8.0
#: Swings after the gripper has stopped that are needed to estimate damping.
DAMPING_SWINGS = 3.0
#: Limits that are noted: share of detected values, and share of uneven steps.
LEAST_SEEN, MOST_UNEVEN = 0.9, 0.05
#: The first frequency of one cable differs less between trials: a nonlinear swing of twice the size
#: changes it by some percent.
FREQUENCY = 0.15
#: Range of stated noise over that from frame to frame at rest, which is a part of it: filters of a
#: camera or a distorted lens explain larger ratios, up to the upper limit.
STATED_NOISE = (1.0 / 3.0, 20.0)
#: No cable is inserted by more than half a turn of its gripper.
MOST_TURN_RAD = np.pi
#: Number of trials from which a median is reliable.
MEDIAN_OF = 3
#: Least motion of the tip, in noise standard deviations.
SPAN_OF_NOISE = 20.0


@dataclass(frozen=True)
class TrialRecord:
    """Facts of a trial, and the stated noise of its study; None = not stated."""

    facts: TrialFacts
    noise_std_m: float | None

    @property
    def after_s(self) -> float:
        """Duration of the record after the gripper has stopped, s."""
        f = self.facts
        return f.to_s - (f.from_s if f.moves_s is None else f.moves_s[1])

    @property
    def peaks_hz(self) -> tuple[float, ...]:
        """Frequencies of the swing after that, the strongest first; empty = none."""
        spectrum = self.facts.spectrum
        return () if spectrum is None or self.after_s <= 0.0 else spectrum.peaks_hz

    @property
    def shows_nothing(self) -> bool:
        """Whether nothing moves the cable, and it does not swing."""
        spectrum = self.facts.spectrum
        swings = spectrum is not None and spectrum.peaks_hz
        return never_moves.failure(self) is not None and not swings


@noted(
    "motion of the gripper",
    "none",
    "the gripper never moves, and the cable is not let go;",
    "record a motion",
)
def never_moves(record: TrialRecord) -> Failure | None:
    """Does the gripper move, or is the cable let go?"""
    facts = record.facts
    return Failure({}) if facts.moves_s is None and facts.start == "equilibrium" else None


@noted(
    "frames at rest",
    f"{REST_FRAMES}",
    "{shown} the cable at rest;",
    f"record {REST_FRAMES} or more before the motion, for the noise is known from these",
)
def rest_frames(record: TrialRecord) -> Failure | None:
    """Is the noise known from frames at rest, if it is not stated?"""
    facts = record.facts
    stated = record.noise_std_m is not None or facts.start == "moving"
    if stated or facts.rest_frames >= REST_FRAMES:
        return None
    return Failure({"shown": counted(facts.rest_frames, "frame shows", "frames show")})


@noted(
    "share of the values that are seen",
    f"{LEAST_SEEN:g}",
    "{seen:.0%} of the values were seen;",
    "see which markers are lost when",
)
def lost_values(record: TrialRecord) -> Failure | None:
    """Were most marker positions measured?"""
    share = record.facts.seen
    return Failure({"seen": share}) if share < LEAST_SEEN else None


@noted(
    "share of the steps that are a fifth off the usual one",
    f"{MOST_UNEVEN:g}",
    "{irregular:.0%} of the steps of time are uneven;",
    "are frames missing?",
)
def uneven_steps(record: TrialRecord) -> Failure | None:
    """Are the steps of time even?"""
    irregular = record.facts.irregular
    return Failure({"irregular": irregular}) if irregular > MOST_UNEVEN else None


@noted(
    "span of the tip over the noise",
    f"{SPAN_OF_NOISE:g}",
    "the tip moves by {tip_mm:.2g} mm, only {times:.2g} times the noise;",
    "move the gripper farther or faster",
)
def small_motion(record: TrialRecord) -> Failure | None:
    """Is the motion larger than the noise?"""
    tip_m, noise_m = record.facts.tip_m, record.facts.noise_m
    if not np.isfinite(noise_m) or tip_m >= SPAN_OF_NOISE * noise_m:
        return None
    return Failure({"tip_mm": tip_m * 1e3, "times": tip_m / noise_m})


@noted(
    "distance of the curve through the resting markers from it, lengths",
    f"{ROOT_AWAY:g}",
    "at rest the curve through the markers begins {away_mm:.2g} mm from the gripping point, "
    "limit {limit_mm:.2g} mm;",
    "check the gripper's place, arc lengths and both frames",
)
def root_away(record: TrialRecord) -> Failure | None:
    """Does the cable begin at the gripping point?"""
    end = record.facts.clamped_end
    if end is None or end.away_m <= ROOT_AWAY * end.length_m:
        return None
    return Failure({"away_mm": end.away_m * 1e3, "limit_mm": ROOT_AWAY * end.length_m * 1e3})


@noted(
    "largest distance of a marker from it, lengths",
    f"{OFF_CURVE:g}",
    "at rest the marker at arc length {arc_m:g} m is {off_mm:.2g} mm from a smooth curve, "
    "limit {limit_mm:.2g} mm;",
    "check its arc length and the order of markers",
)
def off_curve(record: TrialRecord) -> Failure | None:
    """Do the markers lie on a smooth curve at rest?"""
    end = record.facts.clamped_end
    if end is None or end.worst_m <= OFF_CURVE * end.length_m:
        return None
    limit_mm = OFF_CURVE * end.length_m * 1e3
    return Failure({"arc_m": end.worst_arc_m, "off_mm": end.worst_m * 1e3, "limit_mm": limit_mm})


@noted(
    "span of the clamp angle, degrees",
    f"{np.degrees(MOST_TURN_RAD):.0f}",
    f"the gripper turns by {{turned_deg:.0f}}°, limit {np.degrees(MOST_TURN_RAD):.0f}°;",
    "check the unit of its angle, and whether whole turns are missing",
)
def turns_far(record: TrialRecord) -> Failure | None:
    """Does the gripper turn by less than half a turn?"""
    turned_rad = record.facts.hand_rad
    return Failure({"turned_deg": np.degrees(turned_rad)}) if turned_rad > MOST_TURN_RAD else None


@noted(
    "angle between both at rest, degrees",
    f"{np.degrees(ROOT_TURNED_RAD):.0f}",
    "at rest the cable leaves the clamp {turned_deg:+z.0f}° from its angle, limit "
    f"{np.degrees(ROOT_TURNED_RAD):.0f}°;",
    "check angle_rad (positive = pointing down) and the axes",
)
def root_turned(record: TrialRecord) -> Failure | None:
    """Does the cable leave the clamp at the clamp angle?"""
    end = record.facts.clamped_end
    if end is None or abs(end.turned_rad) <= ROOT_TURNED_RAD:
        return None
    return Failure({"turned_deg": np.degrees(end.turned_rad)})


@noted(
    "largest distance of both, each from its median, over the gripper's motion",
    f"{ROOT_MOTION_ERROR:g}, and twice the uncertainty of the root",
    "the motion of the cable's root, extrapolated from its innermost markers, differs from the "
    "gripper's by up to {apart_mm:.2g} mm, limit {limit_mm:.2g} mm{how};",
    "check the units, axes and clocks of both files, and whether frames are missing; camera_scale "
    "and camera_roll show this too",
)
def root_motion_error(record: TrialRecord) -> Failure | None:
    """Does the cable's root move as the gripper does?"""
    root = record.facts.root_motion
    if root is None or root.excess <= ROOT_MOTION_ERROR:
        return None
    how = ""
    if abs(root.scale - 1.0) > ROOT_MOTION_ERROR:
        how = f": it moves {root.scale:.3g} times as far"
    elif abs(root.turned_rad) > ROOT_MOTION_ERROR:
        how = f": it moves in a direction {np.degrees(root.turned_rad):+z.1f}° from the gripper's"
    limit_m = ROOT_MOTION_ERROR * root.way_m + 2.0 * root.uncertainty_m
    return Failure({"apart_mm": root.apart_m * 1e3, "limit_mm": limit_m * 1e3, "how": how})


@noted(
    "time from the gripper's stop to the last frame, s",
    "0",
    "the gripper still moves when the record of the markers ends;",
    "record the swing too",
)
def moves_at_end(record: TrialRecord) -> Failure | None:
    """Is a swing recorded after the motion?"""
    return Failure({}) if record.after_s <= 0.0 else None


@noted(
    "swings and frames after the gripper's stop",
    f"{FEWEST_SWINGS:g} and {FEWEST_FRAMES}",
    "the record ends {after_s:.2g} s after the gripper stops, too soon to show a swing",
    "",
)
def no_swing(record: TrialRecord) -> Failure | None:
    """Does the record show a swing?"""
    shown = record.after_s <= 0.0 or record.peaks_hz
    return None if shown else Failure({"after_s": record.after_s})


@noted(
    "its frequency over 1.2 √(g/L) / 2π",
    f"{OF_CHAIN:g}",
    "the cable swings at {hz:.3g} Hz, and none of its length is slower than {slowest_hz:.3g} Hz;",
    "check the units of time and length",
)
def slow_swing(record: TrialRecord) -> Failure | None:
    """Is the swing no slower than a hanging chain's?"""
    scale = record.facts.swings
    if scale is None or not record.peaks_hz:
        return None
    slow = min(record.peaks_hz) < OF_CHAIN * scale.slowest_hz
    values = {"hz": min(record.peaks_hz), "slowest_hz": scale.slowest_hz}
    return Failure(values) if slow else None


@noted(
    "its frequency over √(1.545 g/δ) / 2π",
    f"{OF_DROOP:g} or its inverse",
    "the cable swings at {hz:.3g} Hz, yet one that its weight bends by {droop_mm:.3g} mm "
    "swings at about {droops_hz:.3g} Hz;",
    "check the units of time and length, unless it is naturally curved",
)
def droop(record: TrialRecord) -> Failure | None:
    """Does the swing frequency agree with the droop at rest?"""
    scale = record.facts.swings
    if scale is None or not record.peaks_hz or slow_swing.failure(record) is not None:
        return None
    ratio = min(record.peaks_hz) / scale.droops_hz
    if not np.isfinite(ratio) or 1.0 / OF_DROOP < ratio < OF_DROOP:
        return None
    values = {"droop_mm": scale.droop_m * 1e3, "droops_hz": scale.droops_hz}
    return Failure({"hz": min(record.peaks_hz), **values})


@noted(
    "frames in a swing",
    f"{FRAMES_PER_SWING:.0f}",
    "{rate_hz:.3g} frames a second are {times:.2g} in a swing of {hz:.3g} Hz;",
    f"{FRAMES_PER_SWING:.0f} or more are needed",
)
def few_per_swing(record: TrialRecord) -> Failure | None:
    """Are there enough frames per swing?"""
    rate_hz = record.facts.rate_hz
    if not record.peaks_hz or rate_hz >= FRAMES_PER_SWING * record.peaks_hz[0]:
        return None
    times = rate_hz / record.peaks_hz[0]
    return Failure({"rate_hz": rate_hz, "times": times, "hz": record.peaks_hz[0]})


@noted(
    "swings after the gripper's stop",
    f"{DAMPING_SWINGS:.0f}",
    "the record ends {after_s:.2g} s after the gripper stops, {swings:.2g} swings of {hz:.3g} Hz;",
    f"{DAMPING_SWINGS:.0f} or more show the damping",
)
def few_swings(record: TrialRecord) -> Failure | None:
    """Is the swing recorded long enough for its damping?"""
    if not record.peaks_hz or record.after_s * record.peaks_hz[0] >= DAMPING_SWINGS:
        return None
    swings = record.after_s * record.peaks_hz[0]
    return Failure({"after_s": record.after_s, "swings": swings, "hz": record.peaks_hz[0]})


#: Facts of all trials, and the stated noise of their study.
StudyRecord = tuple[Sequence[TrialFacts], float | None]


@noted(
    "noise_std_m over the noise from frame to frame",
    f"{STATED_NOISE[0]:.2g} to {STATED_NOISE[1]:g}",
    "noise_std_m states {stated_mm:.2g} mm, the frames at rest show {shown_mm:.2g} mm: {what};",
    "correct it, or leave it out",
)
def stated_noise(record: StudyRecord) -> Failure | None:
    """Is the stated noise that of the frames at rest?"""
    trials, noise_std_m = record
    noises_m = [f.noise_m for f in trials if np.isfinite(f.noise_m) and f.noise_m > 0.0]
    if noise_std_m is None or not noises_m:
        return None
    at_rest_m = float(np.median(noises_m))
    if STATED_NOISE[0] * at_rest_m <= noise_std_m <= STATED_NOISE[1] * at_rest_m:
        return None
    text = "hides what the model lacks" if noise_std_m > at_rest_m else "no model can be as right"
    values = {"stated_mm": noise_std_m * 1e3, "shown_mm": at_rest_m * 1e3}
    return Failure({**values, "what": text})


@noted(
    "difference of the strongest frequencies over the lowest",
    f"{FREQUENCY:g}, and the resolution of both",
    "the strongest swing has {low_hz:.3g} Hz in {low} and {high_hz:.3g} Hz in {high}:",
    "are they of one cable, held at the same place?",
)
def frequencies(record: StudyRecord) -> Failure | None:
    """Do all trials swing alike?"""
    strongest = [
        (f.spectrum.peaks_hz[0], f.spectrum.resolution_hz, f.name)
        for f in record[0]
        if f.spectrum is not None and f.spectrum.peaks_hz
    ]
    if len(strongest) < 2:
        return None
    (low_hz, rough_hz, low), (high_hz, also_hz, high) = min(strongest), max(strongest)
    if high_hz - low_hz < max(FREQUENCY * low_hz, rough_hz, also_hz):
        return None
    return Failure({"low_hz": low_hz, "low": low, "high_hz": high_hz, "high": high})


@noted(
    "largest difference from the median of the trials, degrees",
    f"{np.degrees(ROOTS_APART_RAD):.0f}",
    "at rest the cable leaves the clamp {turned_deg:+z.0f}° from its angle in {name}, and "
    "{usual_deg:+z.0f}° in the other trials;",
    "check angle_rad of that trial, or state trials that were gripped anew as another study",
)
def roots_apart(record: StudyRecord) -> Failure | None:
    """Does the cable leave the clamp alike in all trials?"""
    ends = [(f.clamped_end.turned_rad, f.name) for f in record[0] if f.clamped_end is not None]
    if len(ends) < MEDIAN_OF:
        return None
    usual = float(np.median([turned for turned, _ in ends]))
    turned, name = max(ends, key=lambda end: abs(end[0] - usual))
    if abs(turned - usual) <= ROOTS_APART_RAD:
        return None
    degrees = {"turned_deg": np.degrees(turned), "usual_deg": np.degrees(usual)}
    return Failure({**degrees, "name": name})


#: Checks of every trial; all failures are reported, trials with the same sentence together.
RECORD_NOTES = (
    never_moves,
    rest_frames,
    lost_values,
    uneven_steps,
    small_motion,
    root_away,
    off_curve,
    turns_far,
    root_turned,
    root_motion_error,
    moves_at_end,
    no_swing,
    slow_swing,
    droop,
    few_per_swing,
    few_swings,
)
#: Checks of all trials of a study jointly.
STUDY_NOTES = (stated_noise, frequencies, roots_apart)


def oddities(all_facts: Sequence[TrialFacts], noise_std_m: float | None) -> list[str]:
    """Warnings of the checks of each trial and of all trials jointly.

    noise_std_m  stated noise of the study; None = not stated
    """
    of_trials: dict[str, list[str]] = {}
    for each in all_facts:
        record = TrialRecord(each, noise_std_m)
        # Checks of the swing do not apply to a cable that nothing moves.
        checks = (never_moves,) if record.shows_nothing else RECORD_NOTES
        for _, sentence in failures(checks, record):
            of_trials.setdefault(sentence, []).append(each.name)
    notes = [f"{first_of(names, NAMED)}: {sentence}" for sentence, names in of_trials.items()]
    return [*notes, *(s for _, s in failures(STUDY_NOTES, (all_facts, noise_std_m)))]


def stated_oddly(all_facts: Sequence[TrialFacts], noise_std_m: float | None) -> str | None:
    """Warning that the stated noise differs much from the noise at rest; None if it does not."""
    return next((s for _, s in failures([stated_noise], (all_facts, noise_std_m))), None)
