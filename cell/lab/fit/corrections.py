"""Corrections of a study given a fitted model: noise, mesh error, rounding error, sensor gain.

Each function returns the study re-whitened for it, or less it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr as normal_cdf

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.identify.noise import still_frames
from cell.lab.data.noise_likelihood import ProjectedResidual
from cell.lab.data.noise_model import noise_model_of_all_frames, with_level_in
from cell.lab.data.prepared import PreparedStudy, arcs_are_uncertain, with_noise_model
from cell.lab.fit.fitting import Fit, best_initial_states, fit_trials
from cell.lab.fit.projection import nuisance_of, orthonormal
from cell.lab.fit.score_test import score_test
from cell.lab.fit.sensitivity import one_sided, sensitivities


def with_noise_given(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> PreparedStudy:
    """The study with the noise of all frames given a model; see `cell.lab.data.noise_model`.

    effects  that may be missing: what they explain is not taken for noise
    """
    gauges = prepared.gauges
    each = [prepared.noise_model, *([] if gauges is None else [gauges.force, gauges.moment])]
    if all(m.rest is None for m in each) or not prepared.noise_is_measured:
        return prepared
    residuals = projected_residuals(prepared, fit, effects)
    markers, *of_gauges = map(noise_model_of_all_frames, each, residuals)
    if prepared.levels:
        markers = with_level_in(prepared.noise_model, markers, fit_trials(prepared))
    if not of_gauges:
        return with_noise_model(prepared, markers)
    return with_noise_model(prepared, markers, (of_gauges[0], of_gauges[1]))


def projected_residuals(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> list[ProjectedResidual]:
    """Residuals in motion, orthogonal to the parameters and to each effect in its likeliest shape.

    Of all markers, and of a wrench's force and moment in their units, if there are any.  To first
    order a missing effect, whichever it is, is projected out, so that the noise can be estimated
    before the effect is known.
    """
    nuisance = nuisance_of(fit)
    rows = [
        s.rows[score_test(nuisance, s.rows, one_sided=one_sided(s.effect)).shape]
        for s in sensitivities(prepared, fit, effects)
    ]
    residual, basis = nuisance.residual, nuisance.basis
    if rows:
        directions = nuisance.remove(np.concatenate(rows))
        size = np.linalg.norm(directions, axis=1)
        usable = size > 1e-6 * np.maximum(np.linalg.norm(np.concatenate(rows), axis=1), 1e-300)
        of_effects = orthonormal((directions[usable] / size[usable, None]).T, 1e-6)
        residual = residual - of_effects @ (of_effects.T @ residual)
        basis = np.concatenate([basis, of_effects], axis=1)
    trials, gauges = fit_trials(prepared), prepared.gauges
    white = prepared.by_trial(trials, np.concatenate([basis, residual[:, None]], axis=1))
    columns_m, markers_m = [], []
    for trial in trials:
        whitener, level = prepared.whiteners[trial.name], prepared.levels.get(trial.name)
        each = [whitener.error_m(column) for column in white[trial.name].T]
        column_m = np.stack(each, axis=-1)
        column_m[still_frames(trial.markers.t_s, trial.grip, trial.rests_until_s)] = np.nan
        columns_m.append(column_m)
        over = np.ones((1, 1)) if level is None else level.of_markers[:, None]
        markers_m.append(prepared.of_markers(trial, column_m) / over[..., None])
    projected = [_projected(markers_m)]
    if gauges is not None:
        present = [gauges.joined[t.name].rows for t in trials]
        for point, scale in enumerate(gauges.scale, gauges.markers):
            pairs = zip(columns_m, present, strict=True)
            projected.append(_projected([c[p, point] / scale[:, None] for c, p in pairs]))
    return projected


def _projected(columns: Sequence[FloatArray]) -> ProjectedResidual:
    """From per trial (times, …, directions and residual), nan if missing or at rest."""
    flat = [c.reshape(len(c), -1, c.shape[-1]) for c in columns]
    present = [np.isfinite(c[..., -1]) for c in flat]
    directions = np.concatenate([c[p, :-1] for c, p in zip(flat, present, strict=True)])
    basis = [np.zeros((*p.shape, 0)) for p in present]
    if directions.size > 0:
        q, r = np.linalg.qr(directions)
        independent = q @ orthonormal(r, 1e-6, of_largest=True)
        basis = [np.zeros((*p.shape, independent.shape[1])) for p in present]
        ends = np.cumsum([p.sum() for p in present])
        for of_trial, p, part in zip(basis, present, np.split(independent, ends), strict=False):
            of_trial[p] = part
    return ProjectedResidual(tuple(c[..., -1] for c in flat), tuple(basis))


def gain_is_uncertain(prepared: PreparedStudy) -> bool:
    """Whether the study has wrenches whose sensor gain is uncertain."""
    return prepared.gauges is not None and prepared.gauges.gain_std > 0.0


def with_gain_of(prepared: PreparedStudy, fit: Fit) -> PreparedStudy:
    """The study, whitened with the wrench that a fitted model predicts times an uncertain gain.

    A trial that the model cannot simulate stays as it is.
    source  Fuller 1987, Measurement Error Models, sec. 1.1: attenuation by errors in a regressor
    """
    gauges = prepared.gauges
    if gauges is None or not gain_is_uncertain(prepared):
        return prepared
    trials = [t for t in prepared.study.trials if gauges.are_in(t)]
    points = prepared.predict_all(trials, [fit.model], best_initial_states(prepared, fit))
    there = {t.name: p[0] for t, p in zip(trials, points, strict=True) if np.isfinite(p).all()}
    return prepared.rewhitened(gauges=gauges.as_expected(there))


#: The mesh and the step are this many times finer in the simulation that tells their errors, which
#: fall with the square of both: what it still errs by is this share of the difference.
FINER = 2
LEFT = 1.0 / (FINER**2 - 1.0)
#: An error that moves no parameter by more than this share of its standard deviation changes no
#: answer.
NOTICEABLE = 0.5
#: Of a difference by which a marker's place changes with its arc length, as a share of the cable.
SLOPE_STEP = 0.005


def finer(prepared: PreparedStudy) -> PreparedStudy:
    """The prepared study with a finer mesh and a shorter time step."""
    coarse = prepared.solver
    return replace(
        prepared,
        slope_solver=None,
        solver=Solver(
            FINER * coarse.segments, coarse.step_s / FINER, coarse.damping, coarse.threads
        ),
    )


def mesh_error_m(prepared: PreparedStudy, fit: Fit) -> dict[str, FloatArray]:
    """Discretisation error of a fitted model, less what was subtracted already.

    By trial (times, markers, 2), m, of those that can be simulated on both meshes.
    source  Richardson's extrapolation
    """
    trials = prepared.study.trials
    initial_states = best_initial_states(prepared, fit)
    here = prepared.predict_all(trials, [fit.model], initial_states)
    there = finer(prepared).predict_all(trials, [fit.model], initial_states)
    found = {}
    for trial, coarse, fine in zip(trials, here, there, strict=True):
        error_m = (1.0 + LEFT) * (fine[0] - coarse[0])
        if np.all(np.isfinite(error_m)):
            found[trial.name] = error_m - prepared.mesh_m.get(trial.name, 0.0)
    return found


def moves_parameters(prepared: PreparedStudy, error_m: Mapping[str, FloatArray]) -> bool:
    """Whether an error of the markers shifts a parameter by a noticeable part of its std.

    Whitened it is a vector: along no direction does it move the residuals by more than its length.
    """
    square = 0.0
    for trial in prepared.study.trials:
        if (moved := error_m.get(trial.name)) is not None:
            both = prepared.white(trial, np.stack([moved, np.zeros_like(moved)]))
            square += float(np.sum((both[0] - both[1]) ** 2))
    return square > NOTICEABLE**2


def without_mesh_error(
    prepared: PreparedStudy, fit: Fit, error_m: Mapping[str, FloatArray]
) -> PreparedStudy:
    """The study less what a converged mesh would show compared with the solver's.

    A mesh's error moves little with the parameters, so that one fit tells it for all: without it
    an effect that resembles it (`grip_slip`) is found in long records of a long or soft cable.
    error_m  of `mesh_error_m`
    source   deferred correction (Stetter 1978, Numer. Math. 29, 425)
    """
    study = prepared.study.with_places(lambda t: t.markers.xy_m - error_m.get(t.name, 0.0))
    states = best_initial_states(prepared, fit)
    lines = lines_of(prepared, fit.model, states) if arcs_are_uncertain(study) else {}
    taken = {n: e + prepared.mesh_m.get(n, 0.0) for n, e in error_m.items()}
    mesh_m = {**prepared.mesh_m, **taken}
    return prepared.rewhitened(study=study, mesh_m=mesh_m, lines=lines)


def lines_of(
    prepared: PreparedStudy, model: CableModel, initial_states: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Per trial (times, markers, 2) derivative of a model's marker positions by arc length.

    What is measured of it errs with the markers that it is to explain: in long records that alone
    looks like a cable of another length.
    initial_states  by trial (1, unknowns); as noted where it is missing
    """
    study, trials = prepared.study, prepared.study.trials
    arcs_m, step_m = study.arc_length_m, SLOPE_STEP * study.cable.length_m
    ends_m = [np.clip(arcs_m + d, 0.0, study.cable.length_m) for d in (-step_m, step_m)]
    below, above = (
        replace(prepared, study=replace(study, arc_length_m=at_m)).predict_all(
            trials, [model], initial_states
        )
        for at_m in ends_m
    )
    found = {}
    for trial, low, high in zip(trials, below, above, strict=True):
        moved = (high - low)[0, :, : len(arcs_m)] / (ends_m[1] - ends_m[0])[:, None]
        seen = np.isfinite(trial.markers.xy_m[:, : len(arcs_m)]).any(axis=0)
        if np.all(np.isfinite(moved)):
            found[trial.name] = np.where(seen, moved, 0.0)
    return found


#: Neighbouring steps that noise of a step reaches.
REACHED = 8
#: A place is known no better than to this share of a step, and noise of a step hides all.
LEAST_SPREAD, HIDING = 1e-3, 1.0
#: Values are on a grid of steps if the mean of their phases is as long as this; 1 = all are.
ON_GRID = 0.9


def mean_rounding_error(place: FloatArray, std: FloatArray) -> FloatArray:
    """Mean error of normally distributed values that are rounded to whole numbers.

    place  mean of the values before they are rounded
    std    their standard deviation; as `place`, or what broadcasts to it

    It is a function of the place, periodic with the step; noise as large as a step averages it out.
    source  Widrow, Kollar and Liu 1996, IEEE Trans. Instrum. Meas. 45, 353
    """
    within, spread = place - np.round(place), np.clip(std, LEAST_SPREAD, HIDING)
    rounded = np.zeros_like(within)
    for edge in np.arange(REACHED) + 0.5:
        rounded += normal_cdf((within - edge) / spread) - normal_cdf((-within - edge) / spread)
    return np.asarray(rounded - within)


def rounding_error_m(prepared: PreparedStudy, fit: Fit) -> dict[str, FloatArray]:
    """Mean rounding error of a study's values, given that a fitted model is correct.

    Less what has been taken out already.  By trial (times, markers, 2), m; 0 where values are not
    rounded.  Empty where noise hides it, or where the study states its noise.
    """
    noise_model = prepared.noise_model
    step_m = 0.0 if noise_model.rest is None else noise_model.rest.resolution_m
    least = min((level.of_markers.min() for level in prepared.levels.values()), default=1.0)
    if least * noise_model.noise.std_m > HIDING * step_m or not prepared.noise_is_measured:
        return {}
    trials, markers, found = prepared.study.trials, len(prepared.study.arc_length_m), {}
    predicted = prepared.predict_all(trials, [fit.model], best_initial_states(prepared, fit))
    for trial, (points,) in zip(trials, predicted, strict=True):
        level = prepared.levels.get(trial.name)
        over = 1.0 if level is None else level.of_markers[:, None]
        square = (over * noise_model.noise.std_m / step_m) ** 2 - 1.0 / 12.0  # before rounding
        origin, on_grid = _grid((trial.markers.xy_m + prepared.taken_out_m(trial)) / step_m)
        place = (points + prepared.mesh_m.get(trial.name, 0.0)) / step_m
        there = (place - origin)[:, :markers]
        error = mean_rounding_error(there, np.sqrt(np.maximum(square, 0.0)))
        usable = on_grid[:markers] & np.isfinite(error)
        rest_m = np.zeros_like(points) - prepared.rounding_m.get(trial.name, 0.0)
        rest_m[:, :markers] += np.where(usable, error * step_m, 0.0)
        found[trial.name] = rest_m
    return found


def _grid(steps: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Per coordinate (points, 2) where a grid of step 1 begins, and whether there is one.

    steps  (times, points, 2) values in steps, nan where not seen
    """
    seen = np.isfinite(steps)
    phases = np.exp(2j * np.pi * np.where(seen, steps, 0.0)) * seen
    mean = phases.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    return np.angle(mean) / (2.0 * np.pi), np.abs(mean) > ON_GRID


def without_rounding_error(
    prepared: PreparedStudy, error_m: Mapping[str, FloatArray]
) -> PreparedStudy:
    """The study less the mean error of its rounded values.

    While a marker moves over many steps its errors are new in every frame.  While it is slow they
    stay, and look like a misfit: of values that are rounded to three times their noise or more.
    error_m  of `rounding_error_m`
    """
    if not error_m:
        return prepared
    study = prepared.study.with_places(lambda t: t.markers.xy_m - error_m[t.name])
    rounding_m = {n: e + prepared.rounding_m.get(n, 0.0) for n, e in error_m.items()}
    return prepared.rewhitened(study=study, rounding_m=rounding_m)


def corrected(prepared: PreparedStudy, fit: Fit) -> PreparedStudy:
    """The study corrected for mesh error, rounding error and sensor gain, given a fitted model."""
    prepared = without_mesh_error(prepared, fit, mesh_error_m(prepared, fit))
    prepared = without_rounding_error(prepared, rounding_error_m(prepared, fit))
    return with_gain_of(prepared, fit)


def moved_m(before: PreparedStudy, after: PreparedStudy) -> dict[str, FloatArray]:
    """Per trial (times, markers, 2) difference in the markers between two corrections, m."""
    return {t.name: after.taken_out_m(t) - before.taken_out_m(t) for t in after.study.trials}
