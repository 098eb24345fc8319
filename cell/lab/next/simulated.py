"""Simulated trials: copies of a study with a hidden effect and new noise, and planned motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect
from cell.cable.geometry import Motion
from cell.cable.wrench import AS_POINTS
from cell.identify.gauss_newton import UnsimulatedError
from cell.identify.gaussian import covariance_root
from cell.identify.gripper_errors import GripperLogErrors, sampled_motions
from cell.lab.data.gauges import with_gauges, without_gauges
from cell.lab.data.prepared import PreparedStudy, as_measured
from cell.lab.fit.corrections import finer
from cell.lab.fit.fitting import Fit, best_initial_states, errors_m, fit_model
from cell.lab.fit.heldout import heldout_rows
from cell.lab.fit.systematic_error import MOTIONS
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import POLISH
from cell.study.data import Markers, Study, Trial, Wrench
from cell.study.hand_drift import HandDrift


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
        model = fit.model
        if hidden is not None:
            model = replace(model, effects=(*model.effects, hidden))
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
    trials = prepared.study.trials
    model = replace(fit.model, effects=(*fit.model.effects, hidden))
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
        replace(t, grip=_planned_log(measured, t.grip, number)) for number, t in enumerate(planned)
    )
    world = HiddenEffectWorld.of(prepared_planned, fits.base.fit, None, planned)
    study = replace(measured, trials=(*measured.trials, *world.copy(_NOISE).trials))
    reprepared = PreparedStudy.of(study, solver=prepared.solver, work=fits.work)
    return FitCache.of(replace(fits.setup, prepared=reprepared))


def _planned_log(study: Study, motion: Motion, number: int) -> Motion:
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
