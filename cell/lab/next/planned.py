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
    prepared: PreparedStudy, hands: Sequence[tuple[str, Motion]], frame_s: float | None = None
) -> tuple[PreparedStudy, tuple[Trial, ...]]:
    """Trials held out that begin at rest, for motions of the gripper with a name each.

    They show the coordinates that the study's trials show, at their rates, and rows of the wrench
    if these have any.  The gripper's motion is known as exactly as there.  Nothing is lost; every
    coordinate seen is 0.

    frame_s  between pictures; None = as usual in the study
    returns  the study, which knows of these trials' wrenches, and the trials
    """
    study = prepared.unjoined
    trials = [_planned(study, name, hand, frame_s) for name, hand in hands]
    if prepared.gauges is None:
        return prepared, tuple(trials)
    joined, gauges = prepared.gauges.with_planned(trials, study.sensor.gain_std)
    return replace(prepared, gauges=gauges), joined


def usual_step_s(times_s: Sequence[FloatArray]) -> float:
    """Median time between samples, s, of the median record."""
    return float(np.median([np.median(np.diff(t_s)) for t_s in times_s if len(t_s) > 1]))


def _planned(study: Study, name: str, hand: Motion, frame_s: float | None) -> Trial:
    """A trial of which nothing is known but the gripper's motion, and what will be seen when."""
    step_s = frame_s or usual_step_s([t.markers.t_s for t in study.trials])
    t_s = np.arange(hand.t_s[0] + step_s, hand.t_s[-1], step_s)
    every = _every(study)
    frames = np.arange(len(t_s))[:, None, None]
    seen = (every > 0) & (frames % np.maximum(every, 1) == 0)
    markers = Markers(t_s, np.where(seen, 0.0, np.nan))
    drift, wrench = _drift(study, hand), _wrench(study, t_s)
    return Trial(name, "validate", "equilibrium", hand, markers, hand_drift=drift, wrench=wrench)


def _every(study: Study) -> NDArray[np.intp]:
    """(markers, 2) in each of how many frames a coordinate is seen; 0 = in none."""
    found = []
    for trial in study.trials:
        t_s, finite = trial.markers.t_s, np.isfinite(trial.markers.xy_m)
        frame_s = np.median(np.diff(t_s))
        steps = np.full(finite.shape[1:], np.nan)
        for channel in np.argwhere(finite.sum(axis=0) > 1):
            own_s = t_s[finite[:, channel[0], channel[1]]]
            steps[tuple(channel)] = np.median(np.diff(own_s)) / frame_s
        found.append(np.nan_to_num(steps))
    return np.asarray(np.ceil(np.max(found, axis=0) - 0.5), dtype=np.intp)


def _wrench(study: Study, frames_s: FloatArray) -> Wrench | None:
    """Rows of the study's sensor between the first frame and the last."""
    wrenches = [t.wrench for t in study.trials if t.wrench is not None]
    if not wrenches:
        return None
    t_s = np.arange(frames_s[0], frames_s[-1], usual_step_s([w.t_s for w in wrenches]))
    seen = np.any([np.isfinite(w.values).any(axis=0) for w in wrenches], axis=0)
    return Wrench(t_s, np.where(seen, 0.0, np.full((len(t_s), len(seen)), np.nan)))


def _drift(study: Study, hand: Motion) -> HandDrift | None:
    """Error of the gripper's place as in the study's trials, while it moves."""
    drifts = [t.hand_drift for t in study.trials if t.hand_drift is not None]
    if not drifts:
        return None
    pose = np.stack([hand.x_m, hand.y_m, hand.angle_rad])
    moves = np.flatnonzero(np.any(np.diff(pose) != 0.0, axis=0))
    first, last = (moves[0], moves[-1] + 1) if len(moves) else (0, -1)
    return replace(
        drifts[0],
        from_s=float(hand.t_s[first]),
        to_s=float(hand.t_s[last]),
        ends_known=all(d.ends_known for d in drifts),
    )


#: Number of the noise of planned trials: of no copy.
_NOISE = 1_000_000


def with_motions(fits: FitCache, hands: Sequence[tuple[str, Motion]]) -> FitCache:
    """The study with one planned, held-out trial for each named motion of the gripper.

    They begin at rest.  Markers, wrench and gripper are measured at the study's usual rates, with
    its noise, nothing lost.

    raises  ValueError: a name that a trial or another motion has; UnsimulatedError
    """
    prepared = fits.prepared
    measured = as_measured(prepared)
    names = [t.name for t in measured.trials]
    for name, _ in hands:
        if name in names:
            raise ValueError(f"--motion: there is a trial {name!r} already; rename the file")
        names.append(name)
    known, planned = planned_trials(prepared, hands)
    planned = tuple(
        replace(t, grip=_logged(measured, t.grip, number)) for number, t in enumerate(planned)
    )
    world = HiddenEffectWorld.of(known, fits.base.fit, None, planned)
    study = replace(measured, trials=(*measured.trials, *world.copy(_NOISE).trials))
    again = PreparedStudy.of(study, solver=prepared.solver, work=fits.work)
    return FitCache.of(replace(fits.setup, prepared=again))


def _logged(study: Study, hand: Motion, number: int) -> Motion:
    """A gripper as the study's logs would show it: at their rate, with their noise."""
    rng = np.random.default_rng([_NOISE, number])
    step_s = usual_step_s([t.grip.t_s for t in study.trials])
    t_s = np.arange(hand.t_s[0], hand.t_s[-1], step_s)
    noise = np.median([[s.noise_std for s in t.grip.splines] for t in study.trials], axis=0)
    values = (
        spline(t_s) + std * rng.normal(size=len(t_s))
        for spline, std in zip(hand.splines, noise, strict=True)
    )
    return Motion(t_s, *values)
