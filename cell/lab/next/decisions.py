"""Decisions of a diagnosis for random draws of its test scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gaussian import covariance_root
from cell.lab.data.rules import DEFAULT_RULES as RULES
from cell.lab.fit.sensitivity import one_sided
from cell.lab.next.linear_study import LinearStudy, Sensitivities
from cell.lab.search.fitted_model import bic_penalty, p_value_of_fall
from cell.lab.verdict.smooth_part import noise_is_from_rest

BoolArray = NDArray[np.bool_]

#: Number of draws of the scores: the standard error of a probability of 95 % is below 0.5 %.
DRAWS = 4000
#: Number of checks of the slow residual, which reject a right model by chance: heldout_smooth and
#: parameter_constancy.
SLOW_CHECKS = 2


@dataclass(frozen=True)
class StudyConstants:
    """Constants of a study that the limits of its diagnosis depend on, in addition to the rules.

    library     number of effects to choose from
    fitted, heldout   number of values of the fitted and the held-out trials
    independent       independent values per value of autocorrelated noise
    noise_m           residual of a right model
    slow        number of tested slow values of the held-out trials; 0 = not tested
    by_gripper_log, by_gripper_log_heldout  factor by which errors of the log inflate an effect's χ²
    """

    library: int
    fitted: int
    heldout: int
    independent: float
    noise_m: float
    slow: float
    by_gripper_log: float
    by_gripper_log_heldout: float


@dataclass(frozen=True, eq=False)
class EffectDecisions:
    """(draws,) decisions of a diagnosis on one effect added to the baseline.

    significant  on the fitted trials, corrected for the library
    confirmed    on the held-out trials
    evidence     ln likelihood with its penalty, to select the best
    chi2         of all trials, to detect ties
    """

    significant: BoolArray
    confirmed: BoolArray
    evidence: FloatArray
    chi2: FloatArray


@dataclass(frozen=True, eq=False)
class EffectTest:
    """The test of one effect: information of its amplitudes (k, k), and their mean scores.

    inside     in the fit trials; outside: in the held-out ones, allowing for the fit's uncertainty
    shown      the same for the effect alone, the other parameters as fitted
    raw_m2     squared change of the held-out trials by unit amplitudes, m²
    fitted, heldout   slices of its scores among the drawn ones
    """

    effect: type[Effect]
    inside: FloatArray
    outside: FloatArray
    shown: FloatArray
    raw_m2: FloatArray
    fitted: slice
    heldout: slice

    def decide(self, scores: FloatArray, constants: StudyConstants) -> EffectDecisions:
        """Decisions from the scores (draws, all)."""
        t, u = scores[:, self.fitted], scores[:, self.heldout]
        size: FloatArray = np.asarray(np.linalg.solve(self.inside, t.T).T, dtype=np.float64)
        if one_sided(self.effect):
            size = np.asarray(np.maximum(size, 0.0))
        fall = 2.0 * np.sum(size * t, axis=1) - _square(size, self.inside)
        gain = self._gain(size, u) if constants.heldout else np.zeros(len(t))
        significant = fall > constants.by_gripper_log * self.least_fall(constants)
        penalty = bic_penalty([self.effect], constants.fitted, constants.independent)
        return EffectDecisions(
            significant,
            self._confirmed(size, u, gain, constants),
            0.5 * (fall - penalty),
            -fall - 2.0 * gain,
        )

    def least_fall(self, constants: StudyConstants) -> float:
        """Smallest fall of χ² that is significant, corrected for the library, and passes BIC."""
        low, high = 0.0, 1e4
        while high - low > 1e-3:
            middle = 0.5 * (low + high)
            p_value = p_value_of_fall(self.effect, middle)
            low, high = (middle, high) if p_value * constants.library > RULES.significance else (
                low, middle)  # fmt: skip
        return max(high, bic_penalty([self.effect], constants.fitted, constants.independent))

    def _gain(self, size: FloatArray, u: FloatArray) -> FloatArray:
        """ln likelihood ratio of the held-out trials by the effect, its size as fitted."""
        residual = u - size @ self.outside
        joint = self.inside + self.outside
        gain = 2.0 * np.sum(size * u, axis=1) - _square(size, self.outside)
        gain += np.sum(residual * np.linalg.solve(joint, residual.T).T, axis=1)
        log_det = np.linalg.slogdet(joint)[1] - np.linalg.slogdet(self.inside)[1]
        present = np.any(size != 0.0, axis=1)
        return np.where(present, 0.5 * (gain - log_det), 0.0)

    def _confirmed(
        self, size: FloatArray, u: FloatArray, gain: FloatArray, constants: StudyConstants
    ) -> BoolArray:
        """Whether held-out trials confirm it, as in `Confirmation.is_confirmed`."""
        if not constants.heldout:
            return np.zeros(len(size), dtype=bool)
        estimate = np.linalg.solve(self.outside, u.T).T
        fall_m2 = 2.0 * np.sum((size @ self.raw_m2) * estimate, axis=1) - _square(size, self.raw_m2)
        return np.asarray(
            (gain / constants.by_gripper_log_heldout > RULES.heldout_gain)
            & (fall_m2 / constants.heldout > RULES.negligible_share * constants.noise_m**2)
            & (0.5 * _square(size, self.shown) > RULES.heldout_gain)
        )


@dataclass(frozen=True)
class Chances:
    """Probabilities of the possible results of a diagnosis, given a hidden effect.

    found        it is claimed, alone or tied with no more than two others
    confused     another effect is claimed in its place: names, probabilities, the likeliest first
    significant, confirmed, identified, told_apart   each condition for `found` alone
    """

    found: float
    confused: tuple[tuple[str, float], ...]
    significant: float
    confirmed: float
    identified: float
    told_apart: float

    @property
    def missed(self) -> float:
        """Probability that nothing is claimed."""
        return max(0.0, 1.0 - self.found - sum(p for _, p in self.confused))

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {**vars(self), "confused": dict(self.confused), "missed": self.missed}


@dataclass(frozen=True, eq=False)
class Tests:
    """All tests of a diagnosis, given a hidden effect, as functions of the residual.

    effects   the hidden one first
    detectable_at_half_size  slices of scores that detect half of the effect, and their χ² limits
    by_change (n,) scores of the hidden change itself
    noise     (draws, n) of the scores
    """

    effects: tuple[EffectTest, ...]
    detectable_at_half_size: tuple[tuple[slice, float], ...]
    constants: StudyConstants
    by_change: FloatArray
    noise: FloatArray

    @staticmethod
    def of(
        linear: LinearStudy,
        hidden: FloatArray,
        own: Sensitivities,
        rivals: Sequence[Sensitivities],
        constants: StudyConstants,
    ) -> Tests:
        """The tests for a hidden change (rows,), from its own slopes and those of rivals."""
        functions: list[FloatArray] = []
        effects = tuple(_test_of(linear, s, functions) for s in (own, *rivals))
        half_size = []
        can_detect = noise_is_from_rest(linear.all_trials.prepared)
        for other in (None, own.of_parameters) if can_detect else ():
            scores, least = linear.scores_of_trials(other, RULES.significance)
            begin = sum(map(len, functions))
            half_size.append((slice(begin, begin + len(scores)), least))
            functions.append(scores)
        joined = np.concatenate(functions)
        root = covariance_root(linear.covariance(joined))
        noise = np.random.default_rng(0).standard_normal((DRAWS, len(joined))) @ root.T
        return Tests(effects, tuple(half_size), constants, joined @ hidden, noise)

    def chances(self, factor: float) -> Chances:
        """Probabilities with the hidden change multiplied by a factor."""
        scores = self.noise + factor * self.by_change
        decisions = [test.decide(scores, self.constants) for test in self.effects]
        accepted = np.array([j.significant & j.confirmed for j in decisions])
        evidence = np.where(accepted, [j.evidence for j in decisions], -np.inf)
        best, any_accepted = np.argmax(evidence, axis=0), accepted.any(axis=0)
        chi2 = np.array([j.chi2 for j in decisions])
        of_best = np.take_along_axis(chi2, best[None], axis=0)
        tied = chi2 < of_best + RULES.tie_delta_chi2
        tied[best, np.arange(len(best))] = True
        few = tied.sum(axis=0) <= RULES.most_named
        identified = np.ones(len(scores), dtype=bool)
        if self.detectable_at_half_size:
            limits = self.detectable_at_half_size
            squares = [np.sum(scores[:, part] ** 2, axis=1) > least for part, least in limits]
            identified = np.any(squares, axis=0)
        claimed = any_accepted & few & identified
        # a rival that explains less is exchanged for the effect, which is then tested itself
        exchanged = chi2[0] < of_best[0] - RULES.tie_delta_chi2
        right = tied[0] & (accepted[0] | ~exchanged)
        pass_rate = self._right_passes(factor)
        confused = [
            (test.effect.name, pass_rate * float(np.mean(claimed & ~tied[0] & (best == i))))
            for i, test in enumerate(self.effects)
        ]
        return Chances(
            found=pass_rate * float(np.mean(claimed & right)),
            confused=tuple(sorted((o for o in confused if o[1] > 0.0), key=lambda o: -o[1])),
            significant=float(np.mean(decisions[0].significant)),
            confirmed=float(np.mean(decisions[0].confirmed)),
            identified=float(np.mean(identified)),
            told_apart=float(np.mean(few & tied[0])),
        )

    def _right_passes(self, factor: float) -> float:
        """Probability that the right model passes the checks of slow errors.

        Their limit is `residual_significance`; it is `significance` where the error exceeds a small
        share of the baseline's, which happens by chance if the effect is weak.
        """
        if self.constants.slow == 0.0:
            return 1.0
        hidden = self.effects[0]
        score = factor * self.by_change[hidden.heldout]
        before = float(score @ np.linalg.solve(hidden.outside, score))
        by_noise = -float(normal_quantile(RULES.significance)) * np.sqrt(2.0 * self.constants.slow)
        is_weak = RULES.small_share * before < by_noise
        limit = RULES.significance if is_weak else RULES.residual_significance
        return float((1.0 - limit) ** SLOW_CHECKS)


def _test_of(
    linear: LinearStudy, sensitivity: Sensitivities, functions: list[FloatArray]
) -> EffectTest:
    """An effect's test; its score functions are appended to `functions`."""
    rows = sensitivity.rows
    inside = linear.project_out_fitted(rows)
    heldout = linear.heldout(rows)
    weighted = linear.gls_weighted(heldout)
    alone = np.where(linear.fitted, 0.0, rows if sensitivity.alone is None else sensitivity.alone)
    raw = linear.raw_m(heldout)
    begin = sum(map(len, functions))
    functions += [inside, linear.heldout_scores(weighted)]
    count = len(rows)
    return EffectTest(
        sensitivity.effect,
        inside @ rows.T,
        weighted @ heldout.T,
        linear.gls_weighted(alone) @ alone.T,
        raw @ raw.T,
        slice(begin, begin + count),
        slice(begin + count, begin + 2 * count),
    )


def _square(values: FloatArray, inner: FloatArray) -> FloatArray:
    """(n,) quadratic forms of vectors (n, k) with a matrix (k, k)."""
    return np.asarray(np.sum((values @ inner) * values, axis=1))
