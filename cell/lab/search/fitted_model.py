"""A set of effects fitted to a study: its evidence, its gain over another set, its residual.

And whether it can be a model of the cable at all, and which of its parameters are at bounds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import Options
from cell.identify.noise import rms
from cell.lab.data.prepared import PreparedStudy, once_per_study
from cell.lab.data.results import Errors, Peak
from cell.lab.fit.fitting import Fit, errors_m, fit_trials
from cell.lab.fit.heldout import Heldout, heldout
from cell.lab.fit.score_test import boundary_p_value
from cell.lab.fit.sensitivity import one_sided, shape_count
from cell.lab.fit.series import rms_by_time, spectrum
from cell.lab.fit.systematic_error import GripperLogError
from cell.study.data import Study


def p_value_of_fall(effect: type[Effect], delta_chi2: float) -> float:
    """p-value of a fall of χ² by a refit with one more effect, if that effect is absent."""
    amplitudes = sum(p.amplitude for p in effect.parameters)
    return boundary_p_value(delta_chi2, amplitudes, int(one_sided(effect)), shape_count(effect))


def bic_penalty(effects: Iterable[type[Effect]], values: int, effective_fraction: float) -> float:
    """Fall of χ² that effects must exceed by BIC; autocorrelated values count as fewer."""
    fitted = sum(p.fitted for e in effects for p in e.parameters)
    return float(fitted * np.log(max(values * effective_fraction, 2.0)))


#: Options of a first refit; the best few are then continued to convergence.
REFIT = Options(tolerance=0.3, max_iterations=12, least_gain=1e-3, updates=3)
POLISH = Options(tolerance=0.1, max_iterations=40, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A set of effects, fitted, with its evidence.

    evidence  ln of the fit trials' likelihood less BIC's penalty; models are selected by it.  The
              held-out trials are not in it: they only confirm
    """

    effects: tuple[type[Effect], ...]
    fit: Fit
    heldout: Heldout | None
    evidence: float

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(e.name for e in self.effects)

    @property
    def errors(self) -> Errors:
        """Fitted and held-out error of the markers."""
        held_m = self.heldout.markers_rms_m if self.heldout else float("nan")
        return Errors(self.fit.markers_rms_m, held_m)

    @property
    def predicted_evidence(self) -> float:
        """Predicted evidence of the converged fit, by the linear model at its last step."""
        return self.evidence + 0.5 * (self.fit.objective - self.fit.predicted_objective)

    @property
    def chi2(self) -> float:
        """−2 ln likelihood of all trials, without penalty."""
        return self.fit.objective - 2.0 * (self.heldout.log_likelihood if self.heldout else 0.0)


@dataclass(frozen=True)
class Gain:
    """Gain by one more effect: fall of χ² on the fit trials, its p-value and BIC; held out."""

    delta_chi2: float
    p_value: float
    delta_bic: float
    heldout: float


def model_of_fit(
    prepared: PreparedStudy, effects: tuple[type[Effect], ...], fit: Fit
) -> FittedModel:
    """A fit with its error on the held-out trials and its evidence."""
    held = heldout(prepared.on_one_core(), fit)
    penalty = penalty_of(prepared, effects)
    return FittedModel(effects, fit, held, evidence=-0.5 * (fit.objective + penalty))


def error_over_noise(prepared: PreparedStudy, model: FittedModel) -> float:
    """Larger of the fitted and the held-out error of a model over the measurement's noise."""
    over, held = model.fit.rms_m / prepared.noise_m("fit"), model.heldout
    return over if held is None else max(over, held.rms_m / prepared.noise_m("validate"))


def penalty_of(prepared: PreparedStudy, effects: Sequence[type[Effect]]) -> float:
    """BIC's penalty of a model's effects: the fall of χ² that they must exceed."""
    count = prepared.count(fit_trials(prepared))
    return bic_penalty(effects, count, prepared.noise_model.noise.effective_fraction)


def residuals_m(prepared: PreparedStudy, candidate: FittedModel) -> dict[str, FloatArray]:
    """Per trial (times, channels): measured − predicted, m, nan where not observed."""
    names = [trial.name for trial in fit_trials(prepared)]
    residuals = dict(zip(names, errors_m(prepared, candidate.fit), strict=True))
    if candidate.heldout is not None:
        for trial in prepared.study.role("validate"):
            error = prepared.error_m(trial, candidate.heldout.predicted_m[trial.name])
            residuals[trial.name] = error.reshape(len(error), -1)
    return residuals


def added_effect(small: FittedModel, large: FittedModel) -> type[Effect]:
    """The effect of `large` that `small` lacks."""
    return next(e for e in large.effects if e.name not in small.names)


def error_text(prepared: PreparedStudy, *errors_m: float) -> str:
    """Text: rms errors of successive models on the fit trials, and the noise."""
    noise_m = prepared.expected_m("fit")
    scale, unit = (1e3, "mm") if max(errors_m) >= 1e-4 else (1e6, "µm")
    shown = [f"{error_m * scale:#.3g}" for error_m in (*errors_m, noise_m)]
    return f"error {' → '.join(shown[:-1])} {unit} (noise {shown[-1]})"


def corrected_gain(
    prepared: PreparedStudy, small: FittedModel, large: FittedModel, log_error: GripperLogError
) -> tuple[float, float]:
    """Fall of the objective and held-out ln likelihood ratio, over the log error's inflation.

    log_error  possible error of the gripper log: changes that look like it count less
    """
    change = small.fit.solution.residual - large.fit.solution.residual
    by_trial = prepared.by_trial(fit_trials(prepared), change)
    fall = (small.fit.objective - large.fit.objective) / log_error.inflation(by_trial)
    if not (small.heldout and large.heldout):
        return fall, 0.0
    changes = {}
    for trial in prepared.study.role("validate"):
        each = [model.heldout.predicted_m[trial.name] for model in (small, large) if model.heldout]
        white = prepared.white(trial, np.stack(each))
        changes[trial.name] = white[0] - white[1]
    log_lr = large.heldout.log_likelihood - small.heldout.log_likelihood
    return fall, log_lr / log_error.inflation(changes)


#: The largest lag of the autocorrelation is the number of frames of a trial divided by this.
LARGEST_LAG = 4
MOST_LAGS = 2000


@dataclass(frozen=True)
class ResidualSummary:
    """The residual of a model over all trials of a study.

    mean_square_m2   per coordinate; inf if a trial cannot be simulated
    independent      effective number of independent values: degrees of freedom of the mean square,
                     twice its squared mean over its variance
    """

    mean_square_m2: float
    independent: float

    @property
    def rms_m(self) -> float:
        """Per coordinate, over all trials."""
        return float(np.sqrt(self.mean_square_m2))


@once_per_study
def residual_summary(prepared: PreparedStudy, candidate: FittedModel) -> ResidualSummary:
    """The residual summary of a model over all trials."""
    heldout = candidate.heldout
    if heldout is not None and not np.isfinite(heldout.rms_m):
        return ResidualSummary(np.inf, 2.0)
    errors = list(residuals_m(prepared, candidate).values())
    values = np.concatenate([e.ravel() for e in errors])
    values = values[np.isfinite(values)]
    return ResidualSummary(float(np.mean(values**2)), independent_values(errors))


def independent_values(errors: Sequence[FloatArray]) -> float:
    """Number of independent values whose mean square varies as much as that of these residuals.

    Correlation along the frames and between channels counts: a model errs for many frames and along
    the complete cable.
    errors  per trial (times, channels), nan where not observed
    source  Bartlett 1946, J. R. Stat. Soc. Suppl. 8, 27: Σ ρ² over lags; between channels the
            same sum over the correlation matrix, (tr K)² / tr K²
    """
    filled = [np.where(np.isfinite(e), e, 0.0) for e in errors]
    count = sum(int(np.isfinite(e).sum()) for e in errors)
    power = sum(float(np.sum(e * e)) for e in filled)
    if count == 0 or power == 0.0:
        return 2.0
    covariance = np.sum([e.T @ e for e in filled], axis=0)
    channels = power**2 / float(np.sum(np.square(covariance)))
    frames = count / filled[0].shape[1]
    squares = 0.0
    for lag in range(1, min(MOST_LAGS, max(len(e) for e in filled) // LARGEST_LAG)):
        products = [e[lag:] * e[:-lag] for e in filled if len(e) > LARGEST_LAG * lag]
        r = sum(float(np.sum(p)) for p in products) / power
        squares += r * r - 1.0 / (frames * channels)  # less what chance alone would give
    return max(2.0, float(frames * channels / (1.0 + 2.0 * max(squares, 0.0))))


def log_variance_ratio(better: ResidualSummary, worse: ResidualSummary) -> float:
    """−2 ln of the likelihood ratio of two residuals whose variances are unknown.

    For models that err by more than the measurement, the residual is their uncertainty.
    """
    if not np.isfinite(worse.mean_square_m2):
        return np.inf if np.isfinite(better.mean_square_m2) else 0.0
    return better.independent * float(np.log(worse.mean_square_m2 / better.mean_square_m2))


def vuong_z(
    prepared: PreparedStudy, better: FittedModel, worse: FittedModel, lag_share: float = 0.25
) -> float:
    """Vuong's statistic: difference of the residuals of two wrong models, in standard deviations.

    Their difference is summed over channels and trials frame by frame, so that repeated trials
    count as one motion.  Its standard deviation is that of a correlated series: a gain at a single
    moment of the motion counts little.
    lag_share  largest lag of the covariances, of the longest trial's frames
    source     Vuong 1989, Econometrica 57, 307; long-run variance after Newey and West 1987,
               Econometrica 55, 703
    """
    better_m, worse_m = residuals_m(prepared, better), residuals_m(prepared, worse)
    gain = np.zeros(max(len(e) for e in better_m.values()))
    for name, error in better_m.items():
        gain[: len(error)] += np.nansum(worse_m[name] ** 2 - error**2, axis=1)
    centred, lags = gain - gain.mean(), int(lag_share * len(gain))
    variance = float(centred @ centred)
    for lag in range(1, lags + 1):
        variance += 2.0 * (1.0 - lag / (lags + 1)) * float(centred[lag:] @ centred[:-lag])
    return float(gain.sum() / np.sqrt(variance)) if variance > 0.0 else 0.0


def removed_share(noise_m: float, before: ResidualSummary, after: ResidualSummary) -> float:
    """Share, 0 … 1, of the mean square in excess of noise that the second model removes."""
    if not np.isfinite(after.mean_square_m2):
        return 0.0
    if not np.isfinite(before.mean_square_m2):
        return 1.0
    excess = max(before.mean_square_m2 - noise_m**2, 1e-30)
    return float(np.clip((before.mean_square_m2 - after.mean_square_m2) / excess, 0.0, 1.0))


def peak(prepared: PreparedStudy, candidate: FittedModel) -> Peak:
    """Place of a model's largest residual: trial, then time and marker of largest rms."""
    study = prepared.unjoined
    errors = _of_places(prepared, residuals_m(prepared, candidate))
    trial = max(errors, key=lambda name: np.nan_to_num(rms(errors[name]), nan=-1.0))
    times = next(t.markers.t_s for t in study.trials if t.name == trial)
    error = errors[trial]
    middle_s, by_time = rms_by_time(times, error)
    return Peak(
        trial,
        float(middle_s[np.nanargmax(np.nan_to_num(by_time))]),
        _place(study, errors),
        _frequency(prepared, times, error),
    )


def _of_places(
    prepared: PreparedStudy, errors: Mapping[str, FloatArray]
) -> Mapping[str, FloatArray]:
    """Per trial (frames, channels) errors of the markers alone."""
    if prepared.gauges is None:
        return errors
    markers = {}
    for trial in prepared.study.trials:
        if trial.name in errors:
            error = errors[trial.name].reshape(*trial.markers.xy_m.shape)
            places = prepared.of_markers(trial, error)
            markers[trial.name] = places.reshape(len(places), -1)
    return markers


def _place(study: Study, errors: Mapping[str, FloatArray]) -> float:
    """Arc length of the marker with the largest rms over all trials, m."""
    markers = len(study.arc_length_m)
    by_marker = [
        rms(np.concatenate([e.reshape(len(e), markers, -1)[:, m].ravel() for e in errors.values()]))
        for m in range(markers)
    ]
    return float(study.arc_length_m[int(np.argmax(np.nan_to_num(by_marker)))])


def _frequency(prepared: PreparedStudy, t_s: FloatArray, error: FloatArray) -> float:
    """Frequency at which a residual is farthest above the noise, Hz."""
    if len(t_s) < 8 or not np.isfinite(error).any():
        return float("nan")
    power = spectrum(t_s, error, prepared.noise_model.noise)
    ratio = power.residual_m2_per_hz / power.noise_m2_per_hz
    return float(power.frequency_hz[int(np.argmax(ratio))])


#: A model with an error above this share of the markers' motion (rms) does not fit the cable.
HOPELESS_SHARE = 0.5
#: With an error above this multiple of the motion the study is wrong: no effect is searched. Cables
#: with a missing effect had errors up to 1.2 times the motion, mirrored ones 3 to 12 times.
NO_MODEL = 2.0
#: An amplitude is at its bound within this share of the distance from zero to the bound.
NEAR_BOUND = 0.01


def is_hopeless(prepared: PreparedStudy, fit: Fit) -> bool:
    """Whether the error of a fit is more than half of the markers' motion."""
    return fit.rms_m > HOPELESS_SHARE * marker_motion_m(prepared)


def is_no_model(prepared: PreparedStudy, fit: Fit) -> bool:
    """Whether the error is so much larger than the markers' motion that no effect explains it."""
    return fit.rms_m > NO_MODEL * marker_motion_m(prepared)


@once_per_study
def marker_motion_m(prepared: PreparedStudy) -> float:
    """rms distance of the fit trials' markers from their own means, per coordinate, m."""
    square, count = 0.0, 0
    for trial in fit_trials(prepared):
        for series in trial.markers.xy_m.reshape(len(trial.markers.t_s), -1).T:
            observed = series[np.isfinite(series)]
            if observed.size:
                square += float(np.sum((observed - observed.mean()) ** 2))
                count += observed.size
    return float(np.sqrt(square / max(count, 1)))


def at_bound(fit: Fit) -> list[tuple[str, float, str]]:
    """Fitted parameters that lie at a bound, except amplitudes that are absent there.

    An amplitude very near its bound counts: the small rest hardly changes the objective.
    returns  (name, value, unit) of each
    """
    space, q = fit.space, fit.q
    absent = {
        f"{e.name}.{p.name}": p.default for e in space.effects for p in e.parameters if p.amplitude
    }
    values = space.natural(q)
    parameters = []
    for i, name in enumerate(space.names):
        default = absent.get(name)
        ends = space.natural(space.low)[i], space.natural(space.high)[i]
        tolerance = [0.0 if default is None else NEAR_BOUND * abs(end - default) for end in ends]
        outside = values[i] <= ends[0] + tolerance[0] or values[i] >= ends[1] - tolerance[1]
        if space.low[i] < space.high[i] and outside and default != values[i]:
            parameters.append((name, float(values[i]), space.units[i]))
    return parameters
