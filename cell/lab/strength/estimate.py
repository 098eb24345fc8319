"""Estimates of a model's parameters with intervals for all errors, by omitted effects too.

Most of an omitted effect does not appear in the residual: the other parameters imitate it, and so
are biased by far more than the noise would explain.  The residual shows which effects may be
omitted and how strong they are; from these follows the bias of the parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.fit import frames_detected, variance_inflation
from cell.identify.gaussian import parameters_root
from cell.identify.identified import Identified
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Interval
from cell.lab.data.rules import SIGNIFICANCE
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.fit.projection import is_distinct, orthonormal
from cell.lab.fit.sensitivity import one_sided
from cell.lab.fit.systematic_error import AllTrialsFit, of_all_trials

#: Most effects added, one after another, until the residual is noise.
MOST = 4
#: Number of parts of a trial that count as independent clusters of model error.
PARTS = 4


@dataclass(frozen=True, eq=False)
class OmittedEffectBias:
    """Omitted effects that explain the residual, and the bias of the parameters without them.

    effects     that explain the residual, linearly, the one that explains most first
    covariance  (p, p) of the fit's coordinates by the omission: the square of their shift when the
                effects are added, and its uncertainty; 0 where the residual is noise
    """

    effects: tuple[str, ...]
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class _CandidateEffect:
    """An effect of one shape: rows (amplitudes, rows) by which its amplitudes change the residual.

    orthogonal  the same, projected off the fitted parameters
    """

    effect: type[Effect]
    rows: FloatArray
    orthogonal: FloatArray


def omitted_effect_bias(joint: AllTrialsFit, effects: Iterable[type[Effect]]) -> OmittedEffectBias:
    """The bias of a fitted model's parameters that omitted effects may cause."""
    fit, linear = joint.fit, joint.linear
    p, none = len(fit.q), np.zeros((len(fit.q), len(fit.q)))
    candidates = [e for e in effects if e.name not in {x.name for x in fit.space.effects}]
    chosen, factor = _explaining(joint, _candidates(joint, candidates))
    if not chosen:
        return OmittedEffectBias((), none)
    rows, orthogonal = (np.vstack([getattr(o, v) for o in chosen]) for v in ("rows", "orthogonal"))
    amplitudes = np.linalg.lstsq(orthogonal.T, linear.residual, rcond=1e-8)[0]
    by_each = linear.coordinates(rows)
    shift = by_each @ amplitudes
    spread = by_each @ np.linalg.pinv(orthogonal @ orthogonal.T) @ by_each.T * factor
    all_of = np.zeros((len(fit.solution.q), len(fit.solution.q)))
    free = fit.solution.free
    all_of[np.ix_(free, free)] = np.outer(shift, shift) + spread + _cluster_covariance(joint)
    return OmittedEffectBias(tuple(o.effect.name for o in chosen), all_of[:p, :p])


def _candidates(joint: AllTrialsFit, effects: Sequence[type[Effect]]) -> list[_CandidateEffect]:
    """Effects at every guess of their shape, without those that the parameters imitate fully."""
    candidates = []
    for slopes in joint.sensitivities(effects):
        for rows in slopes.rows:
            orthogonal = joint.linear.remove(rows)
            if is_distinct(orthogonal, rows):
                candidates.append(_CandidateEffect(slopes.effect, rows, orthogonal))
    return candidates


def _explaining(
    joint: AllTrialsFit, options: Sequence[_CandidateEffect]
) -> tuple[list[_CandidateEffect], float]:
    """Effects selected forward while significant, and the residual's variance inflation."""
    prepared, systematic = joint.prepared, joint.systematic_error
    whiteners = [prepared.whiteners[t.name] for t in fit_trials(prepared)]
    chosen: list[_CandidateEffect] = []
    residual, factor = joint.linear.residual, 1.0
    basis = np.zeros((0, len(residual)))
    while len(chosen) < MOST:
        names = {o.effect.name for o in chosen}
        tried = [(o, _explained(o, basis, residual)) for o in options if o.effect.name not in names]
        best, explained = max(tried, key=lambda f: float(f[1] @ f[1]), default=(None, residual))
        if best is None or not (square := float(explained @ explained)) > 0.0:
            break
        after = residual - explained
        inflation = variance_inflation(after[: len(systematic.mesh)], whiteners, len(joint.fit.q))
        expected = inflation + systematic.variance(explained) / square
        p_value = len(options) * float(chi2_sf(len(best.rows), square / expected))
        if p_value > SIGNIFICANCE:
            break
        chosen.append(best)
        basis = orthonormal(np.vstack([basis, best.orthogonal]).T, 1e-8, of_largest=True).T
        residual, factor = after, inflation
    return chosen, factor


def _explained(candidate: _CandidateEffect, basis: FloatArray, residual: FloatArray) -> FloatArray:
    """(rows,) part of the residual that a candidate explains; zero if its sign is wrong."""
    orthogonal = candidate.orthogonal - (candidate.orthogonal @ basis.T) @ basis
    amplitudes = np.linalg.lstsq(orthogonal.T, residual, rcond=1e-8)[0]
    if one_sided(candidate.effect) and amplitudes[0] < 0.0:
        return np.zeros_like(residual)
    return np.asarray(amplitudes @ orthogonal)


def _cluster_covariance(joint: AllTrialsFit) -> FloatArray:
    """(free, free) covariance of the coordinates by clusters: parts of trials.

    source  Liang & Zeger 1986, Biometrika 73, 13: the sandwich of clusters within which anything
            may depend on anything
    """
    prepared, solution, linear = joint.prepared, joint.fit.solution, joint.linear
    inside = np.linalg.inv(linear.triangle.T @ linear.triangle)
    scores = []
    rows = prepared.by_trial(fit_trials(prepared), np.arange(len(linear.residual)))
    for name, of_trial in rows.items():
        in_frames = of_trial.reshape(-1, prepared.whiteners[name].frames)
        for part in np.array_split(in_frames, PARTS, axis=1):
            jacobian = solution.jacobian[part.ravel()][:, solution.free]
            scores.append(jacobian.T @ linear.residual[part.ravel()])
    by_part = np.array(scores) @ inside
    return np.asarray(by_part.T @ by_part * len(scores) / (len(scores) - 1))


def identified(
    prepared: PreparedStudy, fit: Fit, effects: Iterable[type[Effect]] = ()
) -> Identified:
    """A fit as an `Identified` model, with intervals widened by its residual.

    effects  that it may lack: where the residual is not noise, the parameters' shift by those
             that explain it adds to their uncertainty
    """
    trials = fit_trials(prepared)
    whiteners = [prepared.whiteners[t.name] for t in trials]
    solution, p = fit.solution, len(fit.q)
    inflation = variance_inflation(solution.residual, whiteners, len(solution.q))
    # The inflation reduces the information of the data, not of the prior.
    precision = solution.jacobian.T @ solution.jacobian / inflation
    precision[:p, :p] += fit.space.precision
    precision[p:, p:] += np.diag(1.0 / fit.initial_state_std**2)
    noise_only = np.linalg.inv(precision)
    joint = AllTrialsFit(prepared, fit)
    by_log = joint.systematic_error.covariance(noise_only[:p] @ solution.jacobian.T / inflation)
    unfinished = solution.unfinished[:p, :p]
    bias = omitted_effect_bias(joint, effects)
    return Identified(
        space=fit.space,
        mean=fit.q,
        covariance=np.asarray(noise_only[:p, :p] + by_log + bias.covariance + unfinished),
        noise=prepared.expected,
        residual_rms_m=fit.rms_m,
        converged=fit.arrived,
        inflation=inflation,
        frames_used=sum(frames_detected(t) for t in trials),
        frames_total=sum(len(t.markers.t_s) for t in trials),
        iterations=fit.solution.iterations,
        method="map",
        gripper_covariance=by_log,
        lacks=bias.effects,
    )


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
        index = {p: space.names.index(f"{effect.name}.{p.name}") for p in effect.parameters}
        systematic = np.zeros(len(q))
        for i in index.values():
            systematic[i] = self.model_error(space.names[i], float(q[i]))
        spread = np.sqrt(np.diag(self.covariance) + systematic**2)
        reach = float(normal_quantile(0.975)) * spread
        low = space.natural(np.clip(q - reach, space.low, space.high))
        high = space.natural(np.clip(q + reach, space.low, space.high))
        value = space.natural(q)
        return {
            p.name: Interval(float(value[i]), float(low[i]), float(high[i]), p.unit)
            for p, i in index.items()
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
