"""Initial states of cables that begin bent, estimated from their first frames, for any model.

What is unknown is the difference from the model's own equilibrium, so every model needs its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.model import CableModel
from cell.lab.data.prepared import PreparedStudy
from cell.study.data import Markers, Trial

#: First frames, of a cable in motion: for this share of the time that a hanging one needs to swing
#: to and fro, and so many at least.
SHARE_OF_SWING = 0.1
FEWEST_FRAMES = 6
#: Markers are believed to this share of the free length: the model is not fitted yet.
BELIEVED = 1e-3
_PASSES = 3


def estimate_initial_states(
    prepared: PreparedStudy, trials: Sequence[Trial], models: Sequence[CableModel]
) -> dict[str, FloatArray]:
    """By trial the likeliest unknowns of its initial state, (models, unknowns); delays stay at 0.

    Of trials that do not begin bent, 0.  Gauss–Newton on the first frames; what cannot be simulated
    is left at 0.
    """
    return {t.name: _looked(prepared, t, models) for t in trials}


def _looked(prepared: PreparedStudy, trial: Trial, models: Sequence[CableModel]) -> FloatArray:
    state, lanes = prepared.initial_state(trial), len(models)
    initial_states = np.zeros((lanes, state.count))
    if not state.bent:
        return initial_states
    early = _early(prepared, trial)
    seen = np.isfinite(early.markers.xy_m)
    seen[:, len(prepared.study.arc_length_m) :] = False  # what a sensor shows has a tare
    noise_m = max(prepared.noise.std_m, BELIEVED * prepared.study.cable.free_length_m)
    first = int(state.delayed)
    free = np.arange(first, state.count)
    prior = np.diag(1.0 / state.std[free] ** 2)
    every = [m for m in models for _ in range(len(free) + 1)]
    for _ in range(_PASSES):
        tried = np.repeat(initial_states, len(free) + 1, axis=0).reshape(lanes, len(free) + 1, -1)
        for row, i in enumerate(free, 1):
            tried[:, row, i] += state.step[i]
        points = prepared.predict(early, every, tried.reshape(-1, state.count))
        points = points.reshape(lanes, len(free) + 1, *seen.shape)[:, :, seen] / noise_m
        slopes = (points[:, 1:] - points[:, :1]) / state.step[free][:, None]
        missed = early.markers.xy_m[seen] / noise_m - points[:, 0]
        for lane in np.flatnonzero(np.isfinite(points).all(axis=(1, 2))):
            s, here = slopes[lane], initial_states[lane, free]
            step = np.linalg.solve(s @ s.T + prior, s @ missed[lane] - prior @ here)
            initial_states[lane, free] = here + step
        initial_states = np.clip(initial_states, -state.limit, state.limit)
    return initial_states


def _early(prepared: PreparedStudy, trial: Trial) -> Trial:
    """The first frames of a trial, before a held cable is let go if there are any."""
    t_s, study = trial.markers.t_s, prepared.study
    if trial.release_s is not None:
        count = int(np.searchsorted(t_s, trial.release_s, "right"))
        keep = slice(0, count) if count else slice(0, 1)
    else:
        swing_s = 2.0 * np.pi * np.sqrt(study.cable.free_length_m / study.scale_m_per_s2)
        count = int(np.searchsorted(t_s, t_s[0] + SHARE_OF_SWING * swing_s))
        keep = slice(0, max(count, FEWEST_FRAMES))
    return replace(trial, markers=Markers(t_s[keep], trial.markers.xy_m[keep]))
