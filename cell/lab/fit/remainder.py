"""The part of a residual that neither fitted parameters nor effects of the library can explain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.noise import still_frames
from cell.lab.data.noise_levels import seen_in
from cell.lab.data.noise_likelihood import Remainder
from cell.lab.data.noise_model import noise_model_of_all_frames
from cell.lab.data.prepared import PreparedStudy, with_noise_model
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.fit.score_test import score_test
from cell.lab.fit.sensitivity import nuisance_of, one_sided, sensitivities
from cell.study.data import Trial


def with_noise_given(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> PreparedStudy:
    """The study with the noise that all frames tell given a model, within what the rest allows.

    effects  that may be missing: what they explain is not taken for noise
    """
    gauges = prepared.gauges
    each = [prepared.noise_model, *([] if gauges is None else [gauges.force, gauges.moment])]
    if all(m.rest is None for m in each) or not prepared.noise_is_measured:
        return prepared
    left = remainders(prepared, fit, effects)
    markers, *of_gauges = map(noise_model_of_all_frames, each, left)
    if prepared.levels:
        markers = seen_in(prepared.noise_model, markers, fit_trials(prepared))
    if not of_gauges:
        return with_noise_model(prepared, markers)
    return with_noise_model(prepared, markers, (of_gauges[0], of_gauges[1]))


def remainders(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> tuple[Remainder, ...]:
    """Of the frames after the rest, to first order, each effect in its likeliest shape.

    Of all markers, and of a wrench's force and moment in their units, if there are any.

    Where something is missing its own effect takes most of it out of the residual, whichever it
    is, so that the noise can be told before the effect is.
    """
    nuisance = nuisance_of(fit)
    rows = [
        s.rows[score_test(nuisance, s.rows, one_sided=one_sided(s.effect)).shape]
        for s in sensitivities(prepared, fit, effects)
    ]
    left, taken = nuisance.residual, nuisance.basis
    if rows:
        directions = nuisance.remove(np.concatenate(rows))
        size = np.linalg.norm(directions, axis=1)
        usable = size > 1e-6 * np.maximum(np.linalg.norm(np.concatenate(rows), axis=1), 1e-300)
        u, strength, _ = np.linalg.svd((directions[usable] / size[usable, None]).T, False)
        basis = u[:, strength > 1e-6]
        left, taken = left - basis @ (basis.T @ left), np.concatenate([taken, basis], axis=1)
    errors, trials = [], fit_trials(prepared)
    whites = prepared.by_trial(trials, np.concatenate([taken, left[:, None]], axis=1))
    for trial, white in zip(trials, whites.values(), strict=True):
        whitener = prepared.whiteners[trial.name]
        error = np.stack([whitener.error_m(column) for column in white.T], axis=-1)
        error[still_frames(trial.markers.t_s, trial.grip, trial.rests_until_s)] = np.nan
        errors.append(error)
    places = [
        prepared.of_markers(t, e) / level_of(prepared, t)[..., None]
        for t, e in zip(trials, errors, strict=True)
    ]
    found, gauges = [_remainder(places)], prepared.gauges
    if gauges is not None:
        rows = [gauges.joined[t.name].rows for t in trials]
        for point, scale in enumerate(gauges.scale, gauges.markers):
            own = [e[r, point] / scale[:, None] for e, r in zip(errors, rows, strict=True)]
            found.append(_remainder(own))
    return tuple(found)


def level_of(prepared: PreparedStudy, trial: Trial) -> FloatArray:
    """(markers or 1, 1) noise of a trial's markers over that of all."""
    known = prepared.levels.get(trial.name)
    return np.ones((1, 1)) if known is None else known.of_markers[:, None]


def _remainder(errors: Sequence[FloatArray]) -> Remainder:
    """Of per trial (times, …, directions and the residual): what moves, and what was taken out."""
    flat = [e.reshape(len(e), -1, e.shape[-1]) for e in errors]
    seen = [np.isfinite(e[..., -1]) for e in flat]
    rows = np.concatenate([e[s, :-1] for e, s in zip(flat, seen, strict=True)])
    explained = [np.zeros((*s.shape, 0)) for s in seen]
    if rows.size > 0:
        q, r = np.linalg.qr(rows)
        u, strength, _ = np.linalg.svd(r)
        independent = q @ u[:, strength > 1e-6 * strength[0]]
        explained = [np.zeros((*s.shape, independent.shape[1])) for s in seen]
        ends = np.cumsum([s.sum() for s in seen])
        for of_trial, s, part in zip(explained, seen, np.split(independent, ends), strict=False):
            of_trial[s] = part
    return Remainder(tuple(e[..., -1] for e in flat), tuple(explained))
