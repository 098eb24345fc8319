"""A study read from its folder and checked for the lab, with notes on omitted data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cell.cable.geometry import STILL, Motion, moves_from_s
from cell.files.input_error import InputError, Problem
from cell.files.words import first_of
from cell.identify.noise import still_frames
from cell.lab.data.noise_likelihood import DRIFT_DEGREE, RestFrames, resolution_m
from cell.lab.data.noise_model import still_blocks
from cell.lab.data.unknown_start import MODES
from cell.study.clocks import first_motion, with_pull
from cell.study.data import Study, Trial
from cell.study.facts import TrialFacts, trial_facts
from cell.study.folder import read_study, study_folder
from cell.study.independence import without_copies
from cell.study.left_out import without_outliers, without_wrench_outliers
from cell.study.record_checks import stated_oddly
from cell.study.rest_shape import SWING, WEAK_M_PER_S2

#: A rest drifts if a polynomial is this much likelier than a standstill: 2 ln of odds of 1000, by
#: BIC.  Of 133 trials that begin at rest none comes near.
DECISIVE = 2.0 * np.log(1000.0)
#: Degree up to which a polynomial must be better than a standstill, else the test ends: most do.
FIRST_DEGREE = 3
#: Smallest drift in standard deviations of the noise; a smaller one is harmless.
DRIFTS = 1.0
#: Fewest observed values of a trial per unknown of its initial state.
VALUES = 100


@dataclass(frozen=True)
class RestDrift:
    """Motion of a marker before the gripper moves, in one trial: distance, duration, noise.

    bearable  whether the trial determines its initial state: enough frames, and a smooth motion
              before the gripper moves
    """

    trial: str
    moved_m: float
    seconds: float
    noise_m: float
    bearable: bool

    def __str__(self) -> str:
        """Text of the problem, and the remedy."""
        return (
            f"{self.trial}: the cable drifts by {self.moved_m * 1e3:.2g} mm in "
            f"{self.seconds:.2g} s before the gripper moves, noise {self.noise_m * 1e3:.2g} mm, "
            "yet `start: equilibrium` says that it rests; wait until it rests, or give "
            "`start: moving` in study.yaml"
        )


def rest_drifts(study: Study) -> Iterator[RestDrift]:
    """The `RestDrift` of every trial that is stated to begin in equilibrium but does not.

    Without trials with a release while the gripper rests: reading a study reports these.
    """
    for trial in study.trials:
        drift = _drift(study, trial) if trial.start == "equilibrium" else None
        if drift is not None:
            yield drift


def with_tested_starts(study: Study) -> Study:
    """The study; trials that drift before the gripper moves become `moving` if the data allow."""
    drifts = {d.trial: d for d in rest_drifts(study)}
    bearable = {name for name, d in drifts.items() if d.bearable}
    trials = [
        replace(t, start="moving", drifts=True) if t.name in bearable else t for t in study.trials
    ]
    notes = [f"{d}; here it is taken as moving" if d.bearable else str(d) for d in drifts.values()]
    return replace(study, trials=tuple(trials), notes=(*study.notes, *notes))


def _drift(study: Study, trial: Trial) -> RestDrift | None:
    markers = slice(0, len(study.arc_length_m))
    motion = first_motion(trial, study.cable)
    blocks = still_blocks(trial, markers)
    if not blocks or (motion is not None and not motion.from_first):
        return None
    xy_m = trial.markers.xy_m[:, markers]
    resolution = resolution_m(list(xy_m.reshape(len(xy_m), -1).T))
    # a polynomial of half as many parameters as frames would fit the noise
    most = min(len(b.z_m) for b in blocks) // 2 - 1
    if RestFrames.of(blocks, resolution, min(FIRST_DEGREE, most)).degree == 0:
        return None
    rest = RestFrames.of(blocks, resolution, min(DRIFT_DEGREE, most))
    standstill = RestFrames(rest.blocks, 0, resolution)
    if standstill.bic - rest.bic < DECISIVE:
        return None
    noise_m = rest.likeliest()[0].std_m
    course_m = np.zeros((len(study.arc_length_m), 2))
    for block in blocks:
        u = np.linspace(-1.0, 1.0, len(block.z_m))
        powers = np.vander(u, rest.degree + 1)
        smooth_m = powers @ np.linalg.lstsq(powers, block.z_m, rcond=None)[0]
        course_m.ravel()[list(block.series)] = np.ptp(smooth_m, axis=0)
    moved_m = float(np.hypot(*course_m.T).max())
    if moved_m < DRIFTS * noise_m:
        return None
    step_s = float(np.median(np.diff(trial.markers.t_s)))
    enough = int(np.isfinite(xy_m).sum()) >= VALUES * 2 * MODES  # places and velocities
    bearable = rest.degree < DRIFT_DEGREE and enough
    return RestDrift(trial.name, moved_m, rest.frames * step_s, noise_m, bearable)


#: Motion, m, below which positions cannot be measured ones: a camera's noise is larger.
STANDS_M = 1e-6


#: Most wrong values of a column of a gripper log that are reported.
MOST_REPORTED = 3


def open_study(folder: Path) -> Study:
    """Open a study for the lab, from its folder or from that of the cycle that recorded it.

    raises  InputError: it cannot be read, has no fit trial, a trial is too short, or too many
            samples of a marker are wrong
    """
    opened, folder = folder, study_folder(folder)
    study = replace(read_study(folder), filmed=folder != opened)
    facts, problems = list[TrialFacts](), list[Problem]()
    for trial in study.trials:
        message = _no_motion(trial)
        if message is None:
            facts.append(trial_facts(trial, study.arc_length_m, study.gravity_m_per_s2))
            message = _too_short(study, trial, facts[-1])
        if message is not None:
            last = len(trial.markers.t_s) + 1
            table = folder / trial.name / "markers.csv"
            problems.append(Problem(table, last, None, "t_s", message))
    try:
        study = with_pull(study)
    except ValueError as error:
        header, key = folder / "study.yaml", "gravity_m_per_s2"
        problems.append(Problem(header, 1, None, key, str(error)))
    if not study.role("fit"):
        message = "no trial has `role: fit`; mark at least one, the model is fitted to these"
        problems.append(Problem(folder / "study.yaml", 1, None, "trials", message))
    if problems:
        raise InputError(problems)
    notes = [note for t in study.trials for note in _outliers(folder / t.name / "grip.csv", t.grip)]
    stated = None if study.filmed else stated_oddly(facts, study.noise_std_m)
    notes += [] if stated is None else [f"{folder / 'study.yaml'}: {stated}"]
    study = without_wrench_outliers(replace(study, notes=(*study.notes, *notes)), folder)
    return with_tested_starts(without_copies(without_outliers(study)))


def _outliers(log: Path, grip: Motion) -> list[str]:
    """Notes on values of a gripper log that cannot be motion: lines and sizes, by column."""
    notes = []
    splines = dict(zip(("x_m", "y_m", "angle_rad"), grip.splines, strict=True))
    for column, spline in splines.items():
        deviations = {i: float(getattr(grip, column)[i] - spline.value[i]) for i in spline.wrong}
        if not deviations:
            continue
        unit = "mrad" if column == "angle_rad" else "mm"
        largest = sorted(deviations, key=lambda i: -abs(deviations[i]))
        texts = [f"line {i + 2} by {deviations[i] * 1e3:+.2g} {unit}" for i in largest]
        notes.append(
            f"{log}: {column} jumps for a sample or two, which no gripper does: "
            f"{first_of(texts, MOST_REPORTED)}; left out"
        )
    return notes


def _no_motion(trial: Trial) -> str | None:
    """Error text if markers do not move at all; a camera's noise would be more."""
    xy_m = trial.markers.xy_m
    used = np.isfinite(xy_m).any(axis=0)
    if np.any(np.nanmax(xy_m[:, used], axis=0) - np.nanmin(xy_m[:, used], axis=0) > STANDS_M):
        return None
    return (
        f"is the last of {len(xy_m)} rows in which no marker moves by {STANDS_M * 1e3:g} mm: "
        "record a motion, with all digits, or remove the trial"
    )


def _too_short(study: Study, trial: Trial, facts: TrialFacts) -> str | None:
    if facts.spectrum is not None and facts.spectrum.peaks_hz:
        return None  # a swing was observed: no period must be assumed
    t_s = trial.markers.t_s
    still = still_frames(t_s, trial.grip, trial.rests_until_s)
    moving_s = float(t_s[-1] - t_s[min(still.stop, len(t_s) - 1)])
    markers = trial.markers.xy_m[:, 0]
    rest = markers[still] if trial.start == "equilibrium" else markers[len(markers) // 2 :]
    height_m = rest[:, 1] - trial.grip.y_m[0]
    gravity_m_per_s2 = float(np.hypot(*study.gravity_m_per_s2))
    if not np.isfinite(height_m).any() or gravity_m_per_s2 < WEAK_M_PER_S2:
        return None
    droop_m = abs(float(np.nanmean(height_m)))
    period_s = 2.0 * np.pi * np.sqrt(droop_m / (SWING * gravity_m_per_s2))
    if moving_s >= period_s:
        return None
    if trial.start == "equilibrium" and not np.isfinite(moves_from_s(trial.grip)):
        return (
            f"is the last of {len(t_s)} rows in which the gripper moves by less than "
            f"{STILL['x_m'] * 1e3:g} mm, and the cable is not let go: record a motion; give "
            "`start: held` with release_s if it was let go; or remove the trial"
        )
    return (
        f"ends {moving_s:.3f} s after the motion begins, one swing of this cable takes about "
        f"{period_s:.2f} s; record longer or remove the trial"
    )
