"""Corrections of a study given a fitted model: noise, mesh error, rounding error, sensor gain.

Each function returns the study re-whitened, or with the error subtracted.
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
from cell.identify.noise import still_frames
from cell.lab.data.noise_likelihood import ProjectedResidual
from cell.lab.data.noise_model import noise_model_of_all_frames, with_level_in
from cell.lab.data.prepared import PreparedStudy, arcs_are_uncertain, with_noise_model
from cell.lab.fit.fitting import Fit, best_initial_states, fit_trials
from cell.lab.fit.projection import nuisance_of, orthonormal
from cell.lab.fit.score_test import score_test
from cell.lab.fit.sensitivity import one_sided, sensitivities


def with_conditional_noise(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> PreparedStudy:
    """The study with the noise of all frames given a model; see `cell.lab.data.noise_model`.

    effects  that may be missing: the residual that they explain does not count as noise
    """
    gauges = prepared.gauges
    models = [prepared.noise_model, *([] if gauges is None else [gauges.force, gauges.moment])]
    if all(m.rest is None for m in models) or not prepared.noise_is_measured:
        return prepared
    residuals = projected_residuals(prepared, fit, effects)
    markers, *of_gauges = map(noise_model_of_all_frames, models, residuals)
    if prepared.levels:
        markers = with_level_in(prepared.noise_model, markers, fit_trials(prepared))
    if not of_gauges:
        return with_noise_model(prepared, markers)
    return with_noise_model(prepared, markers, (of_gauges[0], of_gauges[1]))


def projected_residuals(
    prepared: PreparedStudy, fit: Fit, effects: Sequence[type[Effect]]
) -> list[ProjectedResidual]:
    """Residuals in motion, orthogonal to the parameters and to each effect in its likeliest shape.

    For all markers, and a wrench's force and moment in their units, if there are any.  To first
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

    A trial that the model cannot simulate is not changed.
    source  Fuller 1987, Measurement Error Models, sec. 1.1: attenuation by errors in a regressor
    """
    gauges = prepared.gauges
    if gauges is None or not gain_is_uncertain(prepared):
        return prepared
    trials = [t for t in prepared.study.trials if gauges.are_in(t)]
    points = prepared.predict_all(trials, [fit.model], best_initial_states(prepared, fit))
    predicted = {t.name: p[0] for t, p in zip(trials, points, strict=True) if np.isfinite(p).all()}
    return prepared.rewhitened(gauges=gauges.as_expected(predicted))


#: Refinement of mesh and step to estimate their errors, which fall with the square of both: the
#: remaining error of the finer simulation is this share of the difference.
FINER = 2
REMAINDER = 1.0 / (FINER**2 - 1.0)
#: An error that shifts parameters by less than this share of their std is negligible.
NOTICEABLE = 0.5
#: Step of arc length for the derivative of a marker's position, as a share of the cable.
SLOPE_STEP = 0.005


def finer(prepared: PreparedStudy) -> PreparedStudy:
    """The prepared study with a finer mesh and a shorter time step."""
    coarse = prepared.solver
    fine = replace(coarse, segments=FINER * coarse.segments, step_s=coarse.step_s / FINER)
    return replace(prepared, slope_solver=None, solver=fine)


def mesh_error_m(prepared: PreparedStudy, fit: Fit) -> dict[str, FloatArray]:
    """Discretisation error of a fitted model, less the part already subtracted.

    By trial (times, markers, 2), m, of those that can be simulated on both meshes.
    source  Richardson's extrapolation
    """
    trials = prepared.study.trials
    initial_states = best_initial_states(prepared, fit)
    coarse_points = prepared.predict_all(trials, [fit.model], initial_states)
    fine_points = finer(prepared).predict_all(trials, [fit.model], initial_states)
    errors_m = {}
    for trial, coarse, fine in zip(trials, coarse_points, fine_points, strict=True):
        error_m = (1.0 + REMAINDER) * (fine[0] - coarse[0])
        if np.all(np.isfinite(error_m)):
            errors_m[trial.name] = error_m - prepared.mesh_m.get(trial.name, 0.0)
    return errors_m


def moves_parameters(prepared: PreparedStudy, error_m: Mapping[str, FloatArray]) -> bool:
    """Whether an error of the markers shifts a parameter by a noticeable part of its std.

    The norm of the whitened error bounds its effect on any parameter, in standard deviations.
    """
    square = 0.0
    for trial in prepared.study.trials:
        if (moved := error_m.get(trial.name)) is not None:
            pair = prepared.white(trial, np.stack([moved, np.zeros_like(moved)]))
            square += float(np.sum((pair[0] - pair[1]) ** 2))
    return square > NOTICEABLE**2


def without_mesh_error(
    prepared: PreparedStudy, fit: Fit, error_m: Mapping[str, FloatArray]
) -> PreparedStudy:
    """The study less the difference of a converged mesh from the solver's.

    The mesh's error depends little on the parameters: that of one fit is used for all.  Without the
    correction, long records of a long or soft cable show a similar effect (`grip_slip`) wrongly.
    error_m  of `mesh_error_m`
    source   deferred correction (Stetter 1978, Numer. Math. 29, 425)
    """
    study = prepared.study.with_places(lambda t: t.markers.xy_m - error_m.get(t.name, 0.0))
    states = best_initial_states(prepared, fit)
    lines = lines_of(prepared, fit.model, states) if arcs_are_uncertain(study) else {}
    subtracted = {n: e + prepared.mesh_m.get(n, 0.0) for n, e in error_m.items()}
    mesh_m = {**prepared.mesh_m, **subtracted}
    return prepared.rewhitened(study=study, mesh_m=mesh_m, lines=lines)


def lines_of(
    prepared: PreparedStudy, model: CableModel, initial_states: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Per trial (times, markers, 2) derivative of a model's marker positions by arc length.

    Derivatives from the measured markers would be correlated with the markers' errors: in long
    records that looks like a cable of another length.
    initial_states  by trial (1, unknowns); as recorded where it is missing
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
    lines = {}
    for trial, low, high in zip(trials, below, above, strict=True):
        derivative = (high - low)[0, :, : len(arcs_m)] / (ends_m[1] - ends_m[0])[:, None]
        observed = np.isfinite(trial.markers.xy_m[:, : len(arcs_m)]).any(axis=0)
        if np.all(np.isfinite(derivative)):
            lines[trial.name] = np.where(observed, derivative, 0.0)
    return lines


#: Number of neighbouring rounding steps in the sum.
REACHED = 8
#: Smallest standard deviation of a value in steps; and that from which noise hides the rounding.
LEAST_SPREAD, HIDING = 1e-3, 1.0
#: Values are on a grid of steps if the mean of their unit phasors has this length; 1 = all are.
ON_GRID = 0.9


def mean_rounding_error(place: FloatArray, std: FloatArray) -> FloatArray:
    """Mean error of normally distributed values that are rounded to whole numbers.

    place  mean of the values before they are rounded
    std    their standard deviation; broadcasts to `place`

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

    Less the part already subtracted.  By trial (times, markers, 2), m; 0 where values are not
    rounded.  Empty where noise hides it, or where the study states its noise.
    """
    noise_model = prepared.noise_model
    step_m = 0.0 if noise_model.rest is None else noise_model.rest.resolution_m
    least = min((level.of_markers.min() for level in prepared.levels.values()), default=1.0)
    if least * noise_model.noise.std_m > HIDING * step_m or not prepared.noise_is_measured:
        return {}
    trials, markers, errors_m = prepared.study.trials, len(prepared.study.arc_length_m), {}
    predicted = prepared.predict_all(trials, [fit.model], best_initial_states(prepared, fit))
    for trial, (points,) in zip(trials, predicted, strict=True):
        level = prepared.levels.get(trial.name)
        over = 1.0 if level is None else level.of_markers[:, None]
        square = (over * noise_model.noise.std_m / step_m) ** 2 - 1.0 / 12.0  # before rounding
        origin, on_grid = _grid((trial.markers.xy_m + prepared.subtracted_m(trial)) / step_m)
        place = (points + prepared.mesh_m.get(trial.name, 0.0)) / step_m
        relative = (place - origin)[:, :markers]
        error = mean_rounding_error(relative, np.sqrt(np.maximum(square, 0.0)))
        usable = on_grid[:markers] & np.isfinite(error)
        error_m = np.zeros_like(points) - prepared.rounding_m.get(trial.name, 0.0)
        error_m[:, :markers] += np.where(usable, error * step_m, 0.0)
        errors_m[trial.name] = error_m
    return errors_m


def _grid(steps: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Per coordinate (points, 2) the origin of a grid of step 1, and whether there is one.

    steps  (times, points, 2) values in steps, nan where not observed
    """
    observed = np.isfinite(steps)
    phases = np.exp(2j * np.pi * np.where(observed, steps, 0.0)) * observed
    mean = phases.sum(axis=0) / np.maximum(observed.sum(axis=0), 1)
    return np.angle(mean) / (2.0 * np.pi), np.abs(mean) > ON_GRID


def without_rounding_error(
    prepared: PreparedStudy, error_m: Mapping[str, FloatArray]
) -> PreparedStudy:
    """The study less the mean error of its rounded values.

    For a marker that moves over many steps, rounding errors are independent between frames.  For a
    slow one they are correlated and look like a misfit, if steps are three times the noise or more.
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
    return {t.name: after.subtracted_m(t) - before.subtracted_m(t) for t in after.study.trials}
