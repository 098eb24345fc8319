"""The study corrected for the mean error of rounded values, which stays while a cable is slow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr as normal_cdf

from cell.cable.arrays import FloatArray
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.whitening import whiteners_of
from cell.lab.fit.fitting import Fit, best_initial_states

#: Neighbouring steps that noise of a step reaches.
REACHED = 8
#: A place is known no better than to this share of a step, and noise of a step hides all.
LEAST_SPREAD, HIDING = 1e-3, 1.0
#: Values are on a grid of steps if the mean of their phases is as long as this; 1 = all are.
ON_GRID = 0.9


def mean_rounding_error(place: FloatArray, std: FloatArray) -> FloatArray:
    """Mean of what rounding to whole numbers adds to normal values.

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
    """Mean error of a study's rounded values where a fitted model is right.

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
    trials = [
        replace(t, markers=replace(t.markers, xy_m=t.markers.xy_m - error_m[t.name]))
        for t in prepared.study.trials
    ]
    study = replace(prepared.study, trials=tuple(trials))
    whiteners = whiteners_of(
        study, prepared.noise, prepared.gauges, prepared.lines, prepared.levels
    )
    rounding_m = {n: e + prepared.rounding_m.get(n, 0.0) for n, e in error_m.items()}
    return replace(prepared, study=study, whiteners=whiteners, rounding_m=rounding_m)
