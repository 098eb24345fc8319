"""The part of a residual that neither fitted parameters nor effects of the library can explain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.cable.effects.base import Effect
from cell.identify.noise import still_frames
from cell.lab.data.noise_likelihood import Remainder
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.fit.sensitivity import nuisance_of, one_sided, sensitivities
from cell.lab.statistics.score import score_test


def remainder(prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]) -> Remainder:
    """Of the frames after the rest, to first order, each effect in its likeliest shape.

    Where something is missing its own effect takes most of it out of the residual, whichever it
    is, so that the noise can be told before the effect is.
    """
    nuisance = nuisance_of(fit)
    rows = [
        s.rows[score_test(nuisance, s.rows, one_sided=one_sided(s.effect)).shape]
        for s in sensitivities(prepared, fit, effects)
    ]
    left, taken = nuisance.residual, nuisance.basis.shape[1]
    if rows:
        directions = nuisance.remove(np.concatenate(rows))
        size = np.linalg.norm(directions, axis=1)
        usable = size > 1e-6 * np.maximum(np.linalg.norm(np.concatenate(rows), axis=1), 1e-300)
        u, strength, _ = np.linalg.svd((directions[usable] / size[usable, None]).T, False)
        basis = u[:, strength > 1e-6]
        left, taken = left - basis @ (basis.T @ left), taken + basis.shape[1]
    errors, trials = [], fit_trials(prepared)
    for trial, white in zip(trials, prepared.by_trial(trials, left).values(), strict=True):
        error = prepared.whiteners[trial.name].error_m(white)
        error = error.reshape(len(error), -1)
        error[still_frames(trial.markers.t_s, trial.grip, trial.rests_until_s)] = np.nan
        errors.append(error)
    moving = sum(int(np.isfinite(e).sum()) for e in errors)
    count = max(prepared.count(trials), 1)
    return Remainder(tuple(errors), moving * max(0.0, 1.0 - taken / count))
