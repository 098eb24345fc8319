"""A study with planned trials, simulated by its fitted model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Motion
from cell.lab.data.prepared import PreparedStudy, as_measured
from cell.lab.next.hidden import HiddenEffectWorld
from cell.lab.search.fit_cache import FitCache
from cell.study.data import Markers, Study, Trial, Wrench
from cell.study.hand_drift import HandDrift


def planned_trials(
    prepared: PreparedStudy, motions: Sequence[tuple[str, Motion]], frame_s: float | None = None
) -> tuple[PreparedStudy, tuple[Trial, ...]]:
    """Planned held-out trials that begin at rest, for named motions of the gripper.

    They have the coordinates of the study's trials, at their rates, and rows of the wrench if these
    have any.  The gripper's motion is as accurate as there.  No sample is missing; every observed
    coordinate is 0.

    frame_s  between images; None = the study's usual interval
    returns  the study with these trials' wrenches, and the trials
    """
    study = prepared.unjoined
    trials = [_planned(study, name, motion, frame_s) for name, motion in motions]
    if prepared.gauges is None:
        return prepared, tuple(trials)
    joined, gauges = prepared.gauges.with_planned(trials, study.sensor.gain_std)
    return replace(prepared, gauges=gauges), joined


def usual_step_s(times_s: Sequence[FloatArray]) -> float:
    """Median time between samples, s, of the median record."""
    return float(np.median([np.median(np.diff(t_s)) for t_s in times_s if len(t_s) > 1]))


def _planned(study: Study, name: str, motion: Motion, frame_s: float | None) -> Trial:
    """A planned trial: the gripper's motion, and which coordinates are observed at which times."""
    step_s = frame_s or usual_step_s([t.markers.t_s for t in study.trials])
    t_s = np.arange(motion.t_s[0] + step_s, motion.t_s[-1], step_s)
    intervals = _observation_intervals(study)
    frames = np.arange(len(t_s))[:, None, None]
    observed = (intervals > 0) & (frames % np.maximum(intervals, 1) == 0)
    markers = Markers(t_s, np.where(observed, 0.0, np.nan))
    drift, wrench = _drift(study, motion), _wrench(study, t_s)
    return Trial(name, "validate", "equilibrium", motion, markers, hand_drift=drift, wrench=wrench)


def _observation_intervals(study: Study) -> NDArray[np.intp]:
    """(markers, 2) interval, in frames, between observations of a coordinate; 0 = none."""
    intervals = []
    for trial in study.trials:
        t_s, finite = trial.markers.t_s, np.isfinite(trial.markers.xy_m)
        frame_s = np.median(np.diff(t_s))
        steps = np.full(finite.shape[1:], np.nan)
        for channel in np.argwhere(finite.sum(axis=0) > 1):
            own_s = t_s[finite[:, channel[0], channel[1]]]
            steps[tuple(channel)] = np.median(np.diff(own_s)) / frame_s
        intervals.append(np.nan_to_num(steps))
    return np.asarray(np.ceil(np.max(intervals, axis=0) - 0.5), dtype=np.intp)


def _wrench(study: Study, frames_s: FloatArray) -> Wrench | None:
    """Rows of the study's sensor between the first frame and the last."""
    wrenches = [t.wrench for t in study.trials if t.wrench is not None]
    if not wrenches:
        return None
    t_s = np.arange(frames_s[0], frames_s[-1], usual_step_s([w.t_s for w in wrenches]))
    measured = np.any([np.isfinite(w.values).any(axis=0) for w in wrenches], axis=0)
    return Wrench(t_s, np.where(measured, 0.0, np.full((len(t_s), len(measured)), np.nan)))


def _drift(study: Study, motion: Motion) -> HandDrift | None:
    """Error of the gripper's place as in the study's trials, while it moves."""
    drifts = [t.hand_drift for t in study.trials if t.hand_drift is not None]
    if not drifts:
        return None
    pose = np.stack([motion.x_m, motion.y_m, motion.angle_rad])
    moves = np.flatnonzero(np.any(np.diff(pose) != 0.0, axis=0))
    first, last = (moves[0], moves[-1] + 1) if len(moves) else (0, -1)
    return replace(
        drifts[0],
        from_s=float(motion.t_s[first]),
        to_s=float(motion.t_s[last]),
        ends_known=all(d.ends_known for d in drifts),
    )


#: Seed of the noise of planned trials; no copy has it.
_NOISE = 1_000_000


def with_motions(fits: FitCache, motions: Sequence[tuple[str, Motion]]) -> FitCache:
    """The study with one planned, held-out trial for each named motion of the gripper.

    They begin at rest.  Markers, wrench and gripper are measured at the study's usual rates, with
    its noise and without missing samples.

    raises  ValueError: a name that a trial or another motion has; UnsimulatedError
    """
    prepared = fits.prepared
    measured = as_measured(prepared)
    names = [t.name for t in measured.trials]
    for name, _ in motions:
        if name in names:
            raise ValueError(f"--motion: there is a trial {name!r} already; rename the file")
        names.append(name)
    prepared_planned, planned = planned_trials(prepared, motions)
    planned = tuple(
        replace(t, grip=_logged(measured, t.grip, number)) for number, t in enumerate(planned)
    )
    world = HiddenEffectWorld.of(prepared_planned, fits.base.fit, None, planned)
    study = replace(measured, trials=(*measured.trials, *world.copy(_NOISE).trials))
    reprepared = PreparedStudy.of(study, solver=prepared.solver, work=fits.work)
    return FitCache.of(replace(fits.setup, prepared=reprepared))


def _logged(study: Study, motion: Motion, number: int) -> Motion:
    """The gripper's log of a motion, at the rate and with the noise of the study's logs."""
    rng = np.random.default_rng([_NOISE, number])
    step_s = usual_step_s([t.grip.t_s for t in study.trials])
    t_s = np.arange(motion.t_s[0], motion.t_s[-1], step_s)
    noise = np.median([[s.noise_std for s in t.grip.splines] for t in study.trials], axis=0)
    values = (
        spline(t_s) + std * rng.normal(size=len(t_s))
        for spline, std in zip(motion.splines, noise, strict=True)
    )
    return Motion(t_s, *values)
