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
from cell.lab.data.thresholds import SIGNIFICANCE
from cell.lab.data.work import Progress, no_progress, side_by_side
from cell.lab.fit.all_trials_fit import of_all_trials
from cell.lab.fit.fitting import Fit, fit_model
from cell.lab.fit.score_test import holm
from cell.lab.strength.estimate import MODEL_ERROR
from cell.study.data import Trial

#: Precision with which what trials have in common is held, in fit coordinates (of order 1).
HELD = 1e10
#: Fits to one trial; what a pass gains below this share is far below what a trial is wrong by.
ALONE = Options(tolerance=0.1, max_iterations=20, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class _Quantity:
    """What trials are compared in.

    along  (p,) by which fit coordinates change as it grows by 1
    error  of converged simulations of the same cable, in it
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
class _Alone:
    """What a trial alone asks for, were all that trials have in common known exactly.

    values       (quantities,)
    covariance   (quantities, quantities) of them
    by_common    (quantities, common) by which they change with what trials have in common
    inflation    by which what it leaves widens variances
    """

    values: FloatArray
    covariance: FloatArray
    by_common: FloatArray
    inflation: float


def agreement(
    prepared: PreparedStudy, fit: Fit, progress: Progress = no_progress
) -> tuple[Agreement, ...]:
    """Estimates per trial of the cable's stiffness and damping, and of the fit's effects.

    The trials are of one cable: its exponent, and its EI(s) but for the level, are those of all
    trials together.  Level, viscosity and effects are each trial's own.  What a trial leaves beyond
    noise, with its correlation, widens its intervals.  Nothing of a study of one trial.
    """
    trials = prepared.study.trials
    if len(trials) < 2:
        return ()
    joint = of_all_trials(prepared, fit)
    whole = fit if joint is None else joint.fit
    quantities = _quantities(whole)
    common = _common(whole.space)
    done, on_one_core = itertools.count(1), prepared.on_one_core()

    def one(number: int) -> _Alone | None:
        return _alone(on_one_core, whole, trials[number], quantities, common)

    def asked(number: int, _: _Alone | None) -> None:
        progress(f"asked {trials[number].name} alone", next(done), len(trials))

    progress("asking each trial alone", 0, len(trials))
    with side_by_side(prepared.work, [one], (), len(trials)) as pool:
        alone = pool.map(one, range(len(trials)), lambda _: None, asked)
    inflation = float(np.mean([a.inflation for a in alone if a is not None] or [1.0]))
    uncertain = inflation * common.T @ whole.covariance @ common
    rows = [_said(i, quantities, alone, trials, uncertain) for i in range(len(quantities))]
    adjusted = holm([p for *_, p in rows])
    return tuple(
        Agreement(
            parameter=q.name,
            unit=q.unit,
            value=q.natural(q.of(whole.q)),
            spread=spread,
            p_value=p_value,
            agrees=p_value >= SIGNIFICANCE,
            by_trial=values,
        )
        for q, (values, spread, _), p_value in zip(quantities, rows, adjusted, strict=True)
    )


def _quantities(fit: Fit) -> list[_Quantity]:
    """The geometric mean of EI along the cable, the viscosity, and what of the effects is free."""
    space = fit.space
    unit = np.eye(len(space.names))
    level = unit[: space.knots].sum(axis=0)
    found = [_Quantity("mean_rigidity", space.units[0], level, True, MODEL_ERROR)]
    known = {f"{e.name}.{p.name}" for e in space.effects for p in e.parameters if not p.fitted}
    for i in range(space.knots, len(space.names)):
        if space.names[i] in ("exponent", *known) or space.low[i] == space.high[i]:
            continue
        logarithmic = bool(space.logarithmic[i])
        error = MODEL_ERROR * (1.0 if logarithmic else abs(float(fit.q[i])))
        found.append(_Quantity(space.names[i], space.units[i], unit[i], logarithmic, error))
    return found


def _common(space: ParameterSpace) -> FloatArray:
    """(p, k) orthonormal directions of what trials have in common: EI's shape, and the exponent."""
    k = space.knots
    along = np.zeros((len(space.names), k))
    along[:k, : k - 1] = np.linalg.svd(np.ones((1, k)))[2][1:].T
    along[space.names.index("exponent"), k - 1] = 1.0
    return along


def _alone(
    prepared: PreparedStudy,
    whole: Fit,
    trial: Trial,
    quantities: Sequence[_Quantity],
    common: FloatArray,
) -> _Alone | None:
    """What a trial alone says of the quantities; None if it cannot be simulated alone."""
    space, p = whole.space, len(whole.q)
    own = np.stack([q.along for q in quantities], axis=1)
    free = own @ np.linalg.inv(own.T @ own)
    prior = own.T @ space.precision @ own
    held = (HELD * common) @ common.T
    of_one = replace(
        space,
        mean=whole.q + own @ (free.T @ (space.mean - whole.q)),
        precision=held + free @ prior @ free.T,
    )
    try:
        fit = fit_model(
            prepared, of_one, whole.q, whole.initial_states, trials=[trial], options=ALONE
        )
    except UNSIMULATED:
        return None
    whitener = prepared.whiteners[trial.name]
    slopes = fit.solution.jacobian
    if slopes.shape[1] > p:  # less what its unknown initial state can imitate
        initial_states = np.vstack([slopes[:, p:], np.diag(1.0 / fit.initial_state_std)])
        padded = np.vstack([slopes[:, :p], np.zeros((len(fit.initial_state_std), p))])
        basis = np.linalg.qr(initial_states)[0]
        slopes = padded - basis @ (basis.T @ padded)
    inflation = variance_inflation(fit.solution.residual, [whitener], len(quantities))
    slopes = slopes[:, :p] / np.sqrt(inflation)
    covariance = np.linalg.pinv((slopes @ own).T @ (slopes @ own) + prior, hermitian=True)
    by_common = -covariance @ (slopes @ own).T @ (slopes @ common)
    values = np.array([q.of(fit.q) for q in quantities])
    return _Alone(values, np.asarray(covariance), np.asarray(by_common), inflation)


def _said(
    which: int,
    quantities: Sequence[_Quantity],
    alone: Sequence[_Alone | None],
    trials: Sequence[Trial],
    uncertain: FloatArray,
) -> tuple[tuple[TrialValue, ...], float, float]:
    """What every trial says of a quantity; its spread between trials; p of so much if they agree.

    uncertain  (common, common) covariance of what trials have in common: wrong, it moves all
    source     Cochran 1954, Biometrics 10, 101, with correlated values; spread: DerSimonian and
               Laird 1986, Control. Clin. Trials 7, 177
    """
    quantity = quantities[which]
    reach = float(normal_quantile(0.975))
    found, shown = [], []
    for trial, one in zip(trials, alone, strict=True):
        if one is None or not np.isfinite(one.covariance[which, which]):
            found.append(TrialValue(trial.name, None, None, None))
            continue
        value = float(one.values[which])
        std = float(np.sqrt(one.covariance[which, which] + quantity.error**2))
        ends = (value, value - reach * std, value + reach * std)
        found.append(TrialValue(trial.name, *map(quantity.natural, ends)))
        shown.append((value, std, one.by_common[which]))
    if len(shown) < 2:
        return tuple(found), 0.0, 1.0
    x, own = np.array([s[0] for s in shown]), np.diag([s[1] ** 2 for s in shown])
    by_common = np.stack([s[2] for s in shown])
    weights = np.linalg.inv(own + by_common @ uncertain @ by_common.T)
    ones = np.ones(len(x))
    total = float(ones @ weights @ ones)
    middle = float(ones @ weights @ x) / total
    scatter, dof = float((x - middle) @ weights @ (x - middle)), len(x) - 1
    per_variance = float(np.trace(weights)) - float(ones @ weights @ weights @ ones) / total
    spread = float(np.sqrt(max(0.0, scatter - dof) / per_variance))
    natural = spread * (quantity.natural(middle) if quantity.logarithmic else 1.0)
    return tuple(found), natural, float(chi2_sf(dof, scatter))
