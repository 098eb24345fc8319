"""A set of effects fitted to a study, its evidence, and its gain over another set."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import Options
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Errors
from cell.lab.fit.fitting import Fit, errors_m, fit_trials
from cell.lab.fit.heldout import Heldout, heldout
from cell.lab.fit.score_test import boundary_p_value
from cell.lab.fit.sensitivity import one_sided, shape_count
from cell.lab.fit.systematic_error import GripperLogError


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
