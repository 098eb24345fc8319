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
from cell.lab.data.thresholds import DEFAULT_RULES as RULES
from cell.lab.fit.sensitivity import one_sided
from cell.lab.next.linear_study import LinearStudy, Sensitivities
from cell.lab.search.fitted_model import bic_penalty, p_value_of_fall
from cell.lab.verdict.smooth_part import noise_was_seen

BoolArray = NDArray[np.bool_]

#: Draws of the scores: a probability of 95 % is then known to half a per cent.
DRAWS = 4000
#: Checks of what a model leaves that is slow, which refuse a right model by chance: heldout_smooth
#: and parameter_constancy.
SLOW_CHECKS = 2


@dataclass(frozen=True)
class Circumstances:
    """Constants of a study that the limits of its diagnosis depend on, in addition to the rules.

    library     number of effects that are tried
    fitted, heldout   values of the trials fitted to and held out
    independent       values per value of autocorrelated noise
    noise_m           what a right model leaves
    slow        slow values of the trials held out that are looked at; 0 = none
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
class Judged:
    """(draws,) decisions of a diagnosis on one effect added to the baseline.

    significant  on the trials fitted to, among the library
    confirmed    by the trials held out
    evidence     ln likelihood with its penalty, by which the best is chosen
    chi2         of all trials, by which ties are told
    """

    significant: BoolArray
    confirmed: BoolArray
    evidence: FloatArray
    chi2: FloatArray


@dataclass(frozen=True, eq=False)
class EffectTest:
    """The test of one effect: information of its amplitudes (k, k), and their mean scores.

    inside     in the fit trials; outside: in the held-out ones, allowing for the fit's uncertainty
    shown      the same for the effect alone, all else as fitted
    raw_m2     square by which unit amplitudes change the held-out trials, m²
    fitted, heldout   numbers of its scores among those that are drawn
    """

    effect: type[Effect]
    inside: FloatArray
    outside: FloatArray
    shown: FloatArray
    raw_m2: FloatArray
    fitted: slice
    heldout: slice

    def judged(self, scores: FloatArray, given: Circumstances) -> Judged:
        """By scores (draws, all)."""
        t, u = scores[:, self.fitted], scores[:, self.heldout]
        size: FloatArray = np.asarray(np.linalg.solve(self.inside, t.T).T, dtype=np.float64)
        if one_sided(self.effect):
            size = np.asarray(np.maximum(size, 0.0))
        fall = 2.0 * np.sum(size * t, axis=1) - _square(size, self.inside)
        gain = self._gain(size, u) if given.heldout else np.zeros(len(t))
        significant = fall > given.by_gripper_log * self.least_fall(given)
        penalty = bic_penalty([self.effect], given.fitted, given.independent)
        return Judged(
            significant,
            self._confirmed(size, u, gain, given),
            0.5 * (fall - penalty),
            -fall - 2.0 * gain,
        )

    def least_fall(self, given: Circumstances) -> float:
        """Fall of χ² from which the effect is significant among the library, and pays by BIC."""
        low, high = 0.0, 1e4
        while high - low > 1e-3:
            middle = 0.5 * (low + high)
            p_value = p_value_of_fall(self.effect, middle)
            low, high = (middle, high) if p_value * given.library > RULES.significance else (
                low, middle)  # fmt: skip
        return max(high, bic_penalty([self.effect], given.fitted, given.independent))

    def _gain(self, size: FloatArray, u: FloatArray) -> FloatArray:
        """ln of how much likelier the effect makes the held-out trials, its size as fitted."""
        rest = u - size @ self.outside
        together = self.inside + self.outside
        better = 2.0 * np.sum(size * u, axis=1) - _square(size, self.outside)
        better += np.sum(rest * np.linalg.solve(together, rest.T).T, axis=1)
        grown = np.linalg.slogdet(together)[1] - np.linalg.slogdet(self.inside)[1]
        there = np.any(size != 0.0, axis=1)
        return np.where(there, 0.5 * (better - grown), 0.0)

    def _confirmed(
        self,
        size: FloatArray,
        u: FloatArray,
        gain: FloatArray,
        given: Circumstances,
    ) -> BoolArray:
        """Whether held-out trials bear it out, as `Confirmation.is_given` has it."""
        if not given.heldout:
            return np.zeros(len(size), dtype=bool)
        seen = np.linalg.solve(self.outside, u.T).T
        fall_m2 = 2.0 * np.sum((size @ self.raw_m2) * seen, axis=1) - _square(size, self.raw_m2)
        return np.asarray(
            (gain / given.by_gripper_log_heldout > RULES.heldout_gain)
            & (fall_m2 / given.heldout > RULES.negligible_share * given.noise_m**2)
            & (0.5 * _square(size, self.shown) > RULES.heldout_gain)
        )


@dataclass(frozen=True)
class Chances:
    """Probabilities of the possible results of a diagnosis, given a hidden effect.

    found        it is named, alone or tied with no more than two others, and claimed
    confused     another effect is claimed in its place: names, probabilities, the likeliest first
    significant, confirmed, identified, told_apart   what has to hold for that, each alone
    """

    found: float
    confused: tuple[tuple[str, float], ...]
    significant: float
    confirmed: float
    identified: float
    told_apart: float

    @property
    def missed(self) -> float:
        """Nothing is claimed."""
        return max(0.0, 1.0 - self.found - sum(p for _, p in self.confused))

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {**vars(self), "confused": dict(self.confused), "missed": self.missed}


@dataclass(frozen=True, eq=False)
class Tests:
    """All tests of a diagnosis, given a hidden effect, as functions of the residual.

    effects   the hidden one first
    detectable_at_half_size  scores by which half of the effect would be detected: their numbers,
              and the χ² from which it would
    functions (n, rows) of the residual; by_change: (n,) of them by the hidden change itself
    noise     (draws, n) of the scores
    """

    effects: tuple[EffectTest, ...]
    detectable_at_half_size: tuple[tuple[slice, float], ...]
    given: Circumstances
    by_change: FloatArray
    noise: FloatArray

    @staticmethod
    def of(
        linear: LinearStudy,
        hidden: FloatArray,
        own: Sensitivities,
        rivals: Sequence[Sensitivities],
        given: Circumstances,
    ) -> Tests:
        """Of a hidden change (rows,), its own slopes and those of other effects."""
        functions: list[FloatArray] = []
        effects = tuple(_test_of(linear, s, functions) for s in (own, *rivals))
        half_size = []
        seen = noise_was_seen(linear.all_trials.prepared)
        for other in (None, own.of_parameters) if seen else ():
            scores, least = linear.scores_of_trials(other, RULES.significance)
            begin = sum(map(len, functions))
            half_size.append((slice(begin, begin + len(scores)), least))
            functions.append(scores)
        every = np.concatenate(functions)
        root = covariance_root(linear.covariance(every))
        noise = np.random.default_rng(0).standard_normal((DRAWS, len(every))) @ root.T
        return Tests(effects, tuple(half_size), given, every @ hidden, noise)

    def chances(self, times: float) -> Chances:
        """With the hidden change so many times as large."""
        scores = self.noise + times * self.by_change
        judged = [test.judged(scores, self.given) for test in self.effects]
        accepted = np.array([j.significant & j.confirmed for j in judged])
        evidence = np.where(accepted, [j.evidence for j in judged], -np.inf)
        best, any_is = np.argmax(evidence, axis=0), accepted.any(axis=0)
        chi2 = np.array([j.chi2 for j in judged])
        of_best = np.take_along_axis(chi2, best[None], axis=0)
        tied = chi2 < of_best + RULES.tie_delta_chi2
        tied[best, np.arange(len(best))] = True
        few = tied.sum(axis=0) <= RULES.most_named
        identified = np.ones(len(scores), dtype=bool)
        if self.detectable_at_half_size:
            each = self.detectable_at_half_size
            squares = [np.sum(scores[:, some] ** 2, axis=1) > least for some, least in each]
            identified = np.any(squares, axis=0)
        claimed = any_is & few & identified
        # a rival that explains less is exchanged for the effect, which is then judged by itself
        exchanged = chi2[0] < of_best[0] - RULES.tie_delta_chi2
        right = tied[0] & (accepted[0] | ~exchanged)
        passes = self._right_passes(times)
        others = [
            (test.effect.name, passes * float(np.mean(claimed & ~tied[0] & (best == i))))
            for i, test in enumerate(self.effects)
        ]
        return Chances(
            found=passes * float(np.mean(claimed & right)),
            confused=tuple(sorted((o for o in others if o[1] > 0.0), key=lambda o: -o[1])),
            significant=float(np.mean(judged[0].significant)),
            confirmed=float(np.mean(judged[0].confirmed)),
            identified=float(np.mean(identified)),
            told_apart=float(np.mean(few & tied[0])),
        )

    def _right_passes(self, times: float) -> float:
        """Probability that checks of slow errors let the right model pass.

        They judge by `residual_significance`, and by `significance` where more than a small share
        of what the baseline leaves stays: given a weak effect so much is there by chance.
        """
        if self.given.slow == 0.0:
            return 1.0
        hidden = self.effects[0]
        score = times * self.by_change[hidden.heldout]
        before = float(score @ np.linalg.solve(hidden.outside, score))
        by_chance = -float(normal_quantile(RULES.significance)) * np.sqrt(2.0 * self.given.slow)
        weak = RULES.small_share * before < by_chance
        limit = RULES.significance if weak else RULES.residual_significance
        return float((1.0 - limit) ** SLOW_CHECKS)


def _test_of(linear: LinearStudy, slopes: Sensitivities, functions: list[FloatArray]) -> EffectTest:
    """An effect's test; the functions that it needs are added."""
    rows = slopes.rows
    inside = linear.project_out_fitted(rows)
    held = linear.heldout(rows)
    weighed = linear.gls_weighted(held)
    alone = np.where(linear.fitted, 0.0, rows if slopes.alone is None else slopes.alone)
    raw = linear.raw_m(held)
    begin = sum(map(len, functions))
    functions += [inside, linear.heldout_scores(weighed)]
    count = len(rows)
    return EffectTest(
        slopes.effect,
        inside @ rows.T,
        weighed @ held.T,
        linear.gls_weighted(alone) @ alone.T,
        raw @ raw.T,
        slice(begin, begin + count),
        slice(begin + count, begin + 2 * count),
    )


def _square(values: FloatArray, inner: FloatArray) -> FloatArray:
    """(n,) of vectors (n, k) by (k, k)."""
    return np.asarray(np.sum((values @ inner) * values, axis=1))
