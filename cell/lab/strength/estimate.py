"""Estimates of a model's parameters from all trials, with intervals for all errors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gaussian import parameters_root
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Interval
from cell.lab.fit.all_trials_fit import of_all_trials
from cell.lab.fit.fitting import Fit
from cell.lab.strength.kept_model import omitted_effect_bias

#: Relative difference of the parameters fitted by converged simulators of the same cable.
MODEL_ERROR = 0.01
#: A direction of a trial is tested if the trial has this share of all information on it.
LEAST_KNOWN = 0.01
#: Fewest degrees of freedom for a test of the trials' disagreement.
MIN_FREEDOM = 4


@dataclass(frozen=True, eq=False)
class ParameterEstimate:
    """A model's parameters from every trial of a study.

    fit           to all trials, the held-out ones included: they are no longer needed for tests
    disagreement  mean square of the differences between the trials' own parameters, 1 if by noise
                  alone; the covariance is multiplied by it
    systematic_covariance  (p, p) of errors other than noise: gripper log, mesh, omitted effects,
                  and a fit that was stopped before its minimum
    """

    fit: Fit
    disagreement: float
    systematic_covariance: FloatArray | float = 0.0

    @property
    def covariance(self) -> FloatArray:
        """(p, p) of the fit's coordinates."""
        return np.asarray(self.fit.covariance * self.disagreement + self.systematic_covariance)

    def coordinate(self, name: str) -> tuple[float, float]:
        """The fit's coordinate of a parameter `effect.parameter`, and its standard deviation."""
        i = self.fit.space.names.index(name)
        return float(self.fit.q[i]), float(np.sqrt(max(self.covariance[i, i], 1e-300)))

    def model_error(self, name: str, value: float) -> float:
        """Standard deviation of a parameter `effect.parameter` by the simulation's own error.

        value  of its coordinate
        """
        space, (owner, _, parameter) = self.fit.space, name.partition(".")
        effect = next(e for e in space.effects if e.name == owner)
        logarithmic = space.logarithmic[space.names.index(name)]
        p = next(p for p in effect.parameters if p.name == parameter)
        off = (np.log(p.default) if logarithmic else p.default) if p.amplitude else 0.0
        relative = logarithmic and not p.amplitude
        return MODEL_ERROR * (1.0 if relative else float(abs(value - off)))

    def intervals(self, effect: type[Effect]) -> dict[str, Interval]:
        """Values and 95 % intervals of an effect's parameters."""
        space, q = self.fit.space, self.fit.q
        index = {p.name: space.names.index(f"{effect.name}.{p.name}") for p in effect.parameters}
        systematic = np.zeros(len(q))
        for p in effect.parameters:
            i = index[p.name]
            systematic[i] = self.model_error(f"{effect.name}.{p.name}", float(q[i]))
        spread = np.sqrt(np.diag(self.covariance) + systematic**2)
        reach = float(normal_quantile(0.975)) * spread
        low = space.natural(np.clip(q - reach, space.low, space.high))
        high = space.natural(np.clip(q + reach, space.low, space.high))
        value = space.natural(q)
        return {
            p.name: Interval(
                float(value[index[p.name]]),
                float(low[index[p.name]]),
                float(high[index[p.name]]),
                p.unit,
            )
            for p in effect.parameters
            if p.fitted
        }


def estimate(
    prepared: PreparedStudy, fit: Fit, effects: Iterable[type[Effect]] = ()
) -> ParameterEstimate:
    """The parameters of a fitted model, from all trials; the fit's own if one cannot be simulated.

    effects  that it may lack
    """
    joint = of_all_trials(prepared, fit)
    if joint is None:
        return ParameterEstimate(fit, 1.0)
    solution, p = joint.fit.solution, len(fit.q)
    other = joint.systematic_error.covariance((solution.covariance @ solution.jacobian.T)[:p])
    other = other + omitted_effect_bias(joint, effects).covariance + solution.unfinished[:p, :p]
    return ParameterEstimate(joint.fit, disagreement(prepared, joint.fit), other)


def disagreement(prepared: PreparedStudy, joint: Fit) -> float:
    """Cochran's Q of the trials over its degrees of freedom, at least 1.

    Each trial, linearised at the common fit, has its own estimate of the parameters; where the
    model errs they differ by more than noise explains.
    joint  fit to all trials
    source  Cochran 1954, Biometrics 10, 101; as a factor on the variance: Birge 1932, Phys. Rev.
            40, 207
    """
    solution, p = joint.solution, len(joint.q)
    free = solution.free[:p]
    unit = parameters_root(joint.covariance[np.ix_(free, free)])
    trials = prepared.study.trials
    jacobians = prepared.by_trial(trials, solution.jacobian[:, :p])
    residuals = prepared.by_trial(trials, solution.residual)
    square, dof = 0.0, -float(np.count_nonzero(free))
    for name, of_trial in jacobians.items():
        jacobian = of_trial[:, free] @ unit
        information, directions = np.linalg.eigh(jacobian.T @ jacobian)
        score = directions.T @ (jacobian.T @ residuals[name])
        informative = information > LEAST_KNOWN
        square += float(np.sum(score[informative] ** 2 / information[informative]))
        dof += float(np.count_nonzero(informative))
    return max(1.0, square / dof) if dof >= MIN_FREEDOM else 1.0
