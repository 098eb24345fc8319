"""Test of a stated start: a cable said to be in equilibrium that moves before its gripper does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cell.lab.data.noise_likelihood import DRIFT_DEGREE, RestFrames, resolution_m
from cell.lab.data.noise_model import still_blocks
from cell.lab.data.unknown_start import MODES
from cell.study.data import Study, Trial
from cell.study.plausible import first_motion

#: A rest drifts if a smooth course is so much likelier than a standstill: 2 ln of odds of 1000,
#: by BIC.  Of 133 trials that begin at rest none comes near.
DECISIVE = 2.0 * np.log(1000.0)
#: Degree of the polynomials of which one must be better than a standstill: most rests end here.
FIRST_DEGREE = 3
#: Over the noise's standard deviation; by less a start that is wrong does no harm.
DRIFTS = 1.0
#: Seen values of a trial for each unknown of its initial state, at least: so many can bear it.
VALUES = 100


@dataclass(frozen=True)
class RestDrift:
    """How far a marker moves before the gripper does, in what time, and the noise.

    bearable  whether the trial tells its initial state: it has the frames, and the course before
              the gripper moves is smooth
    """

    trial: str
    moved_m: float
    seconds: float
    noise_m: float
    bearable: bool

    def __str__(self) -> str:
        """What is wrong, and the remedy."""
        return (
            f"{self.trial}: the cable drifts by {self.moved_m * 1e3:.2g} mm in "
            f"{self.seconds:.2g} s before the hand moves, noise {self.noise_m * 1e3:.2g} mm, yet "
            "`start: equilibrium` says that it rests; wait until it rests, or give "
            "`start: moving` in study.yaml"
        )


def rest_drifts(study: Study) -> Iterator[RestDrift]:
    """Of every trial that is said to begin in equilibrium and does not.

    Not of one that is let go while the gripper rests, which is named when a study is read.
    """
    for trial in study.trials:
        found = _drift(study, trial) if trial.start == "equilibrium" else None
        if found is not None:
            yield found


def with_tested_starts(study: Study) -> Study:
    """The study with trials that do not begin at rest taken as moving where they can bear it."""
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
    # A polynomial through half as many frames as there are is no course, but their noise.
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
    unknowns = 2 * MODES
    values = int(np.isfinite(xy_m).sum())
    bearable = rest.degree < DRIFT_DEGREE and values >= VALUES * unknowns
    return RestDrift(trial.name, moved_m, rest.frames * step_s, noise_m, bearable)
