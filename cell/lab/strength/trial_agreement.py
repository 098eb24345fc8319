"""Agreement of the trials of a study: estimates per trial of cable and effects."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.identify.fit import variance_inflation
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Agreement, TrialValue
from cell.lab.data.rules import SIGNIFICANCE
from cell.lab.data.work import Progress, no_progress, side_by_side
from cell.lab.fit.fitting import Fit, fit_model
from cell.lab.fit.score_test import holm
from cell.lab.fit.systematic_error import of_all_trials
from cell.lab.strength.estimate import MODEL_ERROR
from cell.study.data import Trial

#: Precision with which the common parameters are held, in fit coordinates (of order 1).
HELD = 1e10
#: Fits to one trial; a smaller gain per iteration is far below the error of a trial.
ALONE = Options(tolerance=0.1, max_iterations=20, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class _Quantity:
    """A parameter in which trials are compared.

    along  (p,) change of the fit coordinates per unit of it
    error  its difference between converged simulations of the same cable
    """

    name: str
    unit: str
    along: FloatArray
    logarithmic: bool
    error: float

    def natural(self, value: float) -> float:
        """Its natural value."""
        return float(np.exp(value)) if self.logarithmic else value

    def of(self, q: FloatArray) -> float:
        """Its value at fit coordinates."""
        return float(self.along @ q / (self.along @ self.along))


@dataclass(frozen=True, eq=False)
class _TrialEstimate:
    """Estimate of the quantities from one trial, given the common parameters.

    values       (quantities,)
    covariance   (quantities, quantities) of them
    by_common    (quantities, common) their derivatives with respect to the common parameters
    inflation    of the variances by the trial's excess over noise
    """

    values: FloatArray
    covariance: FloatArray
    by_common: FloatArray
    inflation: float


def agreement(
    prepared: PreparedStudy, fit: Fit, progress: Progress = no_progress
) -> tuple[Agreement, ...]:
    """Estimates per trial of the cable's stiffness and damping, and of the fit's effects.

    The trials are of one cable: its exponent, and the shape of its EI(s), are common to all trials.
    Level of EI, viscosity and effects are estimated per trial.  The excess of a trial's residual
    over noise, with its correlation, widens its intervals.  Empty for a study of one trial.
    """
    trials = prepared.study.trials
    if len(trials) < 2:
        return ()
    joint = of_all_trials(prepared, fit)
    joint_fit = fit if joint is None else joint.fit
    quantities = _quantities(joint_fit)
    common = _common(joint_fit.space)
    done, on_one_core = itertools.count(1), prepared.on_one_core()

    def fit_one(number: int) -> _TrialEstimate | None:
        return _trial_estimate(on_one_core, joint_fit, trials[number], quantities, common)

    def report(number: int, _: _TrialEstimate | None) -> None:
        progress(f"asked {trials[number].name} alone", next(done), len(trials))

    progress("asking each trial alone", 0, len(trials))
    with side_by_side(prepared.work, [fit_one], (), len(trials)) as pool:
        alone = pool.map(fit_one, range(len(trials)), lambda _: None, report)
    inflation = float(np.mean([a.inflation for a in alone if a is not None] or [1.0]))
    uncertain = inflation * common.T @ joint_fit.covariance @ common
    rows = [_compared(i, quantities, alone, trials, uncertain) for i in range(len(quantities))]
    adjusted = holm([p for *_, p in rows])
    return tuple(
        Agreement(
            parameter=q.name,
            unit=q.unit,
            value=q.natural(q.of(joint_fit.q)),
            spread=spread,
            p_value=p_value,
            agrees=p_value >= SIGNIFICANCE,
            by_trial=values,
        )
        for q, (values, spread, _), p_value in zip(quantities, rows, adjusted, strict=True)
    )


def _quantities(fit: Fit) -> list[_Quantity]:
    """The geometric mean of EI along the cable, the viscosity, and the effects' free parameters."""
    space = fit.space
    unit = np.eye(len(space.names))
    level = unit[: space.knots].sum(axis=0)
    result = [_Quantity("mean_rigidity", space.units[0], level, True, MODEL_ERROR)]
    fixed = {f"{e.name}.{p.name}" for e in space.effects for p in e.parameters if not p.fitted}
    for i in range(space.knots, len(space.names)):
        if space.names[i] in ("exponent", *fixed) or space.low[i] == space.high[i]:
            continue
        logarithmic = bool(space.logarithmic[i])
        error = MODEL_ERROR * (1.0 if logarithmic else abs(float(fit.q[i])))
        result.append(_Quantity(space.names[i], space.units[i], unit[i], logarithmic, error))
    return result


def _common(space: ParameterSpace) -> FloatArray:
    """(p, k) orthonormal directions of the common parameters: EI's shape, and the exponent."""
    k = space.knots
    along = np.zeros((len(space.names), k))
    along[:k, : k - 1] = np.linalg.svd(np.ones((1, k)))[2][1:].T
    along[space.names.index("exponent"), k - 1] = 1.0
    return along


def _trial_estimate(
    prepared: PreparedStudy,
    joint: Fit,
    trial: Trial,
    quantities: Sequence[_Quantity],
    common: FloatArray,
) -> _TrialEstimate | None:
    """Estimate of the quantities from one trial; None if it cannot be simulated alone."""
    space, p = joint.space, len(joint.q)
    own = np.stack([q.along for q in quantities], axis=1)
    free = own @ np.linalg.inv(own.T @ own)
    prior = own.T @ space.precision @ own
    common_precision = (HELD * common) @ common.T
    trial_space = replace(
        space,
        mean=joint.q + own @ (free.T @ (space.mean - joint.q)),
        precision=common_precision + free @ prior @ free.T,
    )
    try:
        fit = fit_model(
            prepared, trial_space, joint.q, joint.initial_states, trials=[trial], options=ALONE
        )
    except UNSIMULATED:
        return None
    whitener = prepared.whiteners[trial.name]
    jacobian = fit.solution.jacobian
    if jacobian.shape[1] > p:  # project off the unknown initial state
        initial_states = np.vstack([jacobian[:, p:], np.diag(1.0 / fit.initial_state_std)])
        padded = np.vstack([jacobian[:, :p], np.zeros((len(fit.initial_state_std), p))])
        basis = np.linalg.qr(initial_states)[0]
        jacobian = padded - basis @ (basis.T @ padded)
    inflation = variance_inflation(fit.solution.residual, [whitener], len(quantities))
    jacobian = jacobian[:, :p] / np.sqrt(inflation)
    covariance = np.linalg.pinv((jacobian @ own).T @ (jacobian @ own) + prior, hermitian=True)
    by_common = -covariance @ (jacobian @ own).T @ (jacobian @ common)
    values = np.array([q.of(fit.q) for q in quantities])
    return _TrialEstimate(values, np.asarray(covariance), np.asarray(by_common), inflation)


def _compared(
    which: int,
    quantities: Sequence[_Quantity],
    alone: Sequence[_TrialEstimate | None],
    trials: Sequence[Trial],
    common_covariance: FloatArray,
) -> tuple[tuple[TrialValue, ...], float, float]:
    """Values of a quantity per trial, their spread between trials, and the p-value of that spread.

    common_covariance  (common, common) of the common parameters: their error shifts all trials
    source     Cochran 1954, Biometrics 10, 101, with correlated values; spread: DerSimonian and
               Laird 1986, Control. Clin. Trials 7, 177
    """
    quantity = quantities[which]
    reach = float(normal_quantile(0.975))
    result, estimates = [], []
    for trial, trial_estimate in zip(trials, alone, strict=True):
        if trial_estimate is None or not np.isfinite(trial_estimate.covariance[which, which]):
            result.append(TrialValue(trial.name, None, None, None))
            continue
        value = float(trial_estimate.values[which])
        std = float(np.sqrt(trial_estimate.covariance[which, which] + quantity.error**2))
        ends = (value, value - reach * std, value + reach * std)
        result.append(TrialValue(trial.name, *map(quantity.natural, ends)))
        estimates.append((value, std, trial_estimate.by_common[which]))
    if len(estimates) < 2:
        return tuple(result), 0.0, 1.0
    x, variances = np.array([s[0] for s in estimates]), np.diag([s[1] ** 2 for s in estimates])
    by_common = np.stack([s[2] for s in estimates])
    weights = np.linalg.inv(variances + by_common @ common_covariance @ by_common.T)
    ones = np.ones(len(x))
    total = float(ones @ weights @ ones)
    mean = float(ones @ weights @ x) / total
    scatter, dof = float((x - mean) @ weights @ (x - mean)), len(x) - 1
    per_variance = float(np.trace(weights)) - float(ones @ weights @ weights @ ones) / total
    spread = float(np.sqrt(max(0.0, scatter - dof) / per_variance))
    natural = spread * (quantity.natural(mean) if quantity.logarithmic else 1.0)
    return tuple(result), natural, float(chi2_sf(dof, scatter))
