"""Simulated copies of a study with a hidden effect: same motions and frames, new noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.wrench import AS_POINTS
from cell.identify.gauss_newton import UnsimulatedError
from cell.identify.gaussian import covariance_root
from cell.identify.gripper_errors import GripperLogErrors, sampled_motions
from cell.lab.data.gauges import with_gauges, without_gauges
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.corrections import finer
from cell.lab.fit.fitting import Fit, best_initial_states, errors_m, fit_model
from cell.lab.fit.heldout import heldout_rows
from cell.lab.fit.systematic_error import MOTIONS
from cell.lab.search.fitted_model import POLISH
from cell.study.data import Markers, Study, Trial


@dataclass(frozen=True, eq=False)
class HiddenEffectWorld:
    """A fitted cable with a hidden effect, from which copies of the study are simulated.

    clean_m   per trial (times, markers, 2), m, by a finer mesh than the fit's
    channels  (channels, channels) root of the correlation between coordinates; None = independent
    """

    study: Study
    prepared: PreparedStudy
    clean_m: dict[str, FloatArray]
    channels: FloatArray | None

    @staticmethod
    def of(
        prepared: PreparedStudy,
        fit: Fit,
        hidden: ActiveEffect | None,
        trials: Sequence[Trial] | None = None,
    ) -> HiddenEffectWorld:
        """The model of a fit and an effect, on the study's own motions or on other trials'.

        raises  UnsimulatedError: it cannot be simulated
        """
        model = _with(fit.model, hidden)
        trials = prepared.study.trials if trials is None else tuple(trials)
        states = best_initial_states(prepared, fit, trials)
        channels = _channel_correlation(prepared, fit)
        prepared, trials = _with_each_row(prepared, trials)
        places = finer(prepared).predict_all(trials, [model], states)
        if not all(np.all(np.isfinite(points)) for points in places):
            name = "" if hidden is None else f" with {hidden.effect.name} {hidden.values}"
            raise UnsimulatedError(f"the cable{name} cannot be simulated; give a smaller size")
        clean = {t.name: points[0] for t, points in zip(trials, places, strict=True)}
        return HiddenEffectWorld(replace(prepared.study, trials=trials), prepared, clean, channels)

    def copy(self, number: int) -> Study:
        """A simulated repetition of the study; `number` is the seed."""
        rng = np.random.default_rng([number, 20261125])
        trials = tuple(self._measured(t, number, rng) for t in self.study.trials)
        study, gauges = replace(self.study, trials=trials), self.prepared.gauges
        return study if gauges is None else without_gauges(study, gauges)

    def _measured(self, trial: Trial, number: int, rng: np.random.Generator) -> Trial:
        clean_m, missing = self.clean_m[trial.name], ~np.isfinite(trial.markers.xy_m)
        error_m, levels = self._errors_m(rng, clean_m.shape), self.prepared.levels
        if trial.name in levels:
            level = levels[trial.name].of_markers
            error_m[:, : len(level)] *= level[:, None]
        measured_m = clean_m + error_m
        step_m = self._rounded_to_m
        if step_m > 0.0:
            places = measured_m[:, : len(self.study.arc_length_m)]
            places[:] = np.round(places / step_m) * step_m
        measured_m[missing] = np.nan
        return replace(
            trial, grip=_logged(trial, number), markers=Markers(trial.markers.t_s, measured_m)
        )

    @property
    def _rounded_to_m(self) -> float:
        rest = self.prepared.noise_model.rest
        return 0.0 if rest is None else rest.resolution_m

    def _errors_m(self, rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
        """Errors with the study's level, autocorrelation and white share; rounding adds its own.

        Those of gauges have the markers' level, as lengths, and their own autocorrelation.
        """
        noise, frames = self.prepared.noise_model.noise, shape[0]
        ar1_m2, white_m2 = (1.0 - noise.white) * noise.std_m**2, noise.white * noise.std_m**2
        of_rounding = self._rounded_to_m**2 / 12.0
        if of_rounding > 0.0:  # its white share is the rounding itself
            ar1_m2, white_m2 = max(min(ar1_m2, noise.std_m**2 - of_rounding), 0.0), 0.0
        columns = int(np.prod(shape[1:]))  # planned trials may have fewer
        channels = columns if self.channels is None else len(self.channels)
        correlated = rng.standard_normal((frames, channels))
        if self.channels is not None:
            correlated = (correlated @ self.channels.T)[:, :columns]
        ar1 = np.full(shape[1:], noise.ar1)
        if self.prepared.gauges is not None and shape[1] > len(self.study.arc_length_m):
            for point, of_gauge in enumerate(self.prepared.gauges.noises, -AS_POINTS):
                ar1[point] = of_gauge.ar1
        ar1 = ar1.ravel()
        for k in range(1, frames):
            correlated[k] = ar1 * correlated[k - 1] + np.sqrt(1.0 - ar1**2) * correlated[k]
        white = rng.standard_normal(correlated.shape)
        return np.asarray(np.sqrt(ar1_m2) * correlated + np.sqrt(white_m2) * white).reshape(shape)


def _with_each_row(
    prepared: PreparedStudy, trials: Sequence[Trial]
) -> tuple[PreparedStudy, tuple[Trial, ...]]:
    """A prepared study that predicts each row of the trials' wrenches singly, and these trials."""
    joined = prepared.gauges
    if joined is None:
        return prepared, tuple(trials)
    _, gauges = with_gauges(prepared.unjoined, joined.std_m, joined.inflation, averaged=False)
    assert gauges is not None  # the study has wrenches
    separate = without_gauges(replace(prepared.study, trials=tuple(trials)), joined).trials
    planned, gauges = gauges.with_planned(separate, gauges.gain_std, averaged=False)
    return replace(prepared, gauges=gauges, mesh_m={}, rounding_m={}), planned


def refit_residual(prepared: PreparedStudy, fit: Fit, hidden: ActiveEffect) -> FloatArray:
    """(rows,) whitened residual of all trials, refitted to noise-free data with a hidden effect.

    fit     a model of the `fit` trials, to which it is refitted with the effect in them
    raises  UnsimulatedError: it cannot be simulated
    """
    trials, model = prepared.study.trials, _with(fit.model, hidden)
    predicted = prepared.predict_all(trials, [model], best_initial_states(prepared, fit))
    if not all(np.all(np.isfinite(points)) for points in predicted):
        raise UnsimulatedError(f"the cable cannot be simulated with {hidden.effect.name}")
    places = {t.name: points[0] for t, points in zip(trials, predicted, strict=True)}
    study = prepared.study.with_places(
        lambda t: np.where(np.isfinite(t.markers.xy_m), places[t.name], np.nan)
    )
    noise_free = prepared.rewhitened(study=study, mesh_m={}, rounding_m={})
    space = replace(fit.space, mean=fit.q)  # the prior acts with any hidden effect
    refit = fit_model(noise_free, space, fit.q, fit.initial_states, options=POLISH)
    parts = noise_free.by_trial(noise_free.study.role("fit"), refit.solution.residual)
    if held := noise_free.study.role("validate"):
        parts |= noise_free.by_trial(held, heldout_rows(noise_free, refit).residual)
    residual = np.concatenate([parts[t.name] for t in trials])
    if not np.all(np.isfinite(residual)):
        raise UnsimulatedError(f"the cable cannot be simulated with {hidden.effect.name}")
    return residual


def _with(model: CableModel, hidden: ActiveEffect | None) -> CableModel:
    return model if hidden is None else replace(model, effects=(*model.effects, hidden))


def _logged(trial: Trial, number: int) -> Motion:
    """A log of the same motion with new noise, different from the draws of a diagnosis."""
    return sampled_motions(trial.grip, GripperLogErrors(1).of(trial), first=MOTIONS + number)[0]


def _channel_correlation(prepared: PreparedStudy, fit: Fit) -> FloatArray | None:
    """Root of the correlation between channels; None if the residuals are independent."""
    if prepared.noise_model.correlated_channels == 1.0:
        return None
    errors = [np.nan_to_num(e) for e in errors_m(prepared, fit)]
    covariance = np.sum([e.T @ e for e in errors], axis=0)
    observed = np.diag(covariance) > 0.0
    return covariance_root(covariance / np.mean(np.diag(covariance)[observed]))
