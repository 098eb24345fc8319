"""Checks of a model learned from many cables, and gates of a candidate, as two tables.

`LEARNING` has the checks of a diagnosis that apply to many cables.  `GATES` has the conditions that
a candidate must meet before a line uses it: forecasts of unseen cables.  A diagnosis uses p-values
of smooth residuals per trial; the vision of a line has smooth errors of its own, so a line is
judged by the size of the error and by forecasts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.lab.data.check import Check, CheckOutcome, Reading, worst_verdict
from cell.lab.data.noise_model import KNOWN_WITHIN
from cell.lab.data.results import Verdict
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.fit.shared import SharedFit, Spread
from cell.lab.line.effect_fit import EffectFit, LearningResult
from cell.lab.line.forecasts import ForecastPair
from cell.lab.line.learn import CHANCE, end_offset_stds
from cell.lab.verdict.checks import CHECKS
from cell.plan.destination import Destination

#: Fewest forecasts for a rank test; with fewer none may become worse by more than noise.
RANKED_FROM = 5


@dataclass(frozen=True)
class LineRules:
    """Limits at which a line's model is complete, and a candidate good enough for the line.

    most_over_noise, most_named, noise_known_within   as in a diagnosis
    chance               largest deviation attributed to chance, standard deviations
    fewest               minimum number of forecasts to test a candidate
    least_gain, least_gain_m   required relative and absolute improvement of forecasts
    significance         one-sided, of the paired differences over all frames (Wilcoxon)
    repeatability_m      allowed increase of the worst forecast error: repeatability of arm, camera
    lost_passages        allowed number of forecasts that leave the opening
    at_bound             allowed number of parameters at a bound
    identifiable         required distance of an effect from zero, standard deviations
    stays_within         allowed factor of its change if a cable is left out
    alike                allowed relative difference of an effect between cables of one line
    heterogeneous        significance of a larger difference (Cochran's Q): cables of two lines, or
                         a different effect
    """

    most_over_noise: float = DEFAULT_RULES.most_over_noise
    most_named: int = DEFAULT_RULES.most_named
    noise_known_within: float = KNOWN_WITHIN
    chance: float = CHANCE
    fewest: int = 3
    least_gain: float = 0.1
    least_gain_m: float = 1e-5
    significance: float = 0.05
    repeatability_m: float = 1e-4
    lost_passages: int = 0
    at_bound: int = 0
    identifiable: float = 3.0
    stays_within: float = 2.0
    alike: float = 0.1
    heterogeneous: float = 0.01


@dataclass(frozen=True, eq=False)
class LineEvidence:
    """Result of learning, and forecasts by the present model and by the candidate."""

    result: LearningResult
    paired: Sequence[ForecastPair] = ()
    destination: Destination | None = None
    rules: LineRules = LineRules()

    @property
    def fit(self) -> SharedFit:
        """The tested model, fitted to all cables."""
        return self.result.baseline if self.result.best is None else self.result.best.fit

    @property
    def best(self) -> EffectFit:
        """The effects of the candidate."""
        assert self.result.best is not None
        return self.result.best

    @property
    def differing(self) -> list[ForecastPair]:
        """The pairs with at least one forecast: without any the models do not differ."""
        return [
            f for f in self.paired if np.isfinite([f.present.error_m, f.candidate.error_m]).any()
        ]

    @property
    def errors_m(self) -> tuple[FloatArray, FloatArray]:
        """(differing,) tip errors in the destination, of the present model and the candidate."""
        pairs = [(f.present.error_m, f.candidate.error_m) for f in self.differing]
        before, after = np.array(pairs).reshape(-1, 2).T
        return before, after


def error_ratio(evidence: LineEvidence) -> Reading | None:
    """Ratio of the rms error on all cables to the noise."""
    return Reading(evidence.fit.rms_m / evidence.fit.noise_m)


def ends_beyond(evidence: LineEvidence) -> Reading | None:
    """Mean offset of detected from predicted ends, along the cable, in standard deviations."""
    return Reading(end_offset_stds(evidence.fit))


def most_tied(evidence: LineEvidence) -> Reading | None:
    """Number of effects that fit as well as the best one, including it."""
    return None if evidence.result.best is None else Reading(1.0 + len(evidence.result.tied))


def noise_range(evidence: LineEvidence) -> Reading | None:
    """Smallest ratio, over cables, of the noise variance's upper bound to its estimate."""
    cables = evidence.fit.cables
    allowed = [c.noise_model.allowed_over_level for c in cables if c.noise_model.range_m]
    ratios = [a for a in allowed if a is not None]
    if evidence.result.best is not None or not ratios:
        return None
    return Reading(min(ratios))


def forecast_count(evidence: LineEvidence) -> Reading | None:
    """Number of forecasts."""
    paired = evidence.differing
    executions = sum(f.of == "execution" for f in paired)
    text = f"{executions} executions, {len(paired)} in all, needs {evidence.rules.fewest}"
    return Reading(float(len(paired)), text=text)


def _enough(evidence: LineEvidence) -> bool:
    return len(evidence.differing) >= evidence.rules.fewest


def gain_p_value(evidence: LineEvidence) -> Reading | None:
    """p-value of the improvement of forecasts; 1 if the tip in the destination improves too little.

    None if there are too few forecasts.  A small effect is below a single frame's noise; all frames
    together show it.
    """
    rules = evidence.rules
    if not _enough(evidence):
        return None
    before, after = evidence.errors_m
    path_before, path_after = np.array(
        [(f.present.rms_m, f.candidate.rms_m) for f in evidence.differing]
    ).T
    rms = [float(np.sqrt(np.mean(v**2))) for v in (before, after)]
    if len(before) >= RANKED_FROM:
        from scipy.stats import wilcoxon  # import takes 0.5 s, rarely needed

        same = np.array_equal(path_before, path_after)  # else it divides by zero
        p = 1.0 if same else float(wilcoxon(path_before, path_after, alternative="greater").pvalue)
        how = f"p = {p:.2g}"
    else:
        worse = int(np.sum(after > before + evidence.result.baseline.noise_m))
        p, how = float(worse > 0), f"{worse} of {len(before)} worse"
    gain = rms[0] - rms[1]
    enough = rms[1] < (1.0 - rules.least_gain) * rms[0] and gain > rules.least_gain_m
    text = f"{rms[0] * 1e3:.3f} → {rms[1] * 1e3:.3f} mm rms, {how}"
    return Reading(p if enough else 1.0, text=text)


def worst_change(evidence: LineEvidence) -> Reading | None:
    """Increase of the largest forecast error with the candidate, m."""
    if not _enough(evidence):
        return None
    before, after = (float(v.max()) for v in evidence.errors_m)
    return Reading(after - before, text=f"{before * 1e3:.3f} → {after * 1e3:.3f} mm")


def lost_passages(evidence: LineEvidence) -> Reading | None:
    """Number of passages through the opening that the candidate's forecast errors lose."""
    opening = evidence.destination
    if opening is None or not _enough(evidence):
        return None
    half_m = 0.5 * (opening.y_max_m - opening.y_min_m)
    before, after = (int(np.sum(v < half_m)) for v in evidence.errors_m)
    count = len(evidence.differing)
    text = f"{before} → {after} of {count} forecast within ± {half_m * 1e3:.1f} mm"
    return Reading(float(before - after), text=text)


def at_bound(evidence: LineEvidence) -> Reading | None:
    """Number of parameters at a bound."""
    best, fit = evidence.best, evidence.best.fit
    low, high = fit.space.low[fit.common], fit.space.high[fit.common]
    at = [n for n, v, a, b in zip(best.names, fit.theta, low, high, strict=True) if not a < v < b]
    return Reading(float(len(at)), text=", ".join(at) + " at a bound" if at else "all")


def _clearest(candidate: EffectFit) -> list[tuple[int, float, float] | None]:
    """Per effect its most significant amplitude; None = none is fitted.

    returns  index among the shared parameters, coordinate without the effect, and distance from it
             in standard deviations
    """
    fit, std = candidate.fit, np.sqrt(np.diag(candidate.fit.covariance))
    clearest = []
    for effect in candidate.effects:
        amplitudes = []
        for p in effect.parameters:
            name = f"{effect.name}.{p.name}"
            if p.amplitude and name in candidate.names:
                i = candidate.names.index(name)
                logarithmic = fit.space.logarithmic[fit.common[i]]
                without = float(np.log(p.default)) if logarithmic else p.default
                amplitudes.append((i, without, abs(float(fit.theta[i]) - without) / float(std[i])))
        clearest.append(max(amplitudes, key=lambda a: a[2], default=None))
    return clearest


def least_stds(evidence: LineEvidence) -> Reading | None:
    """Smallest distance of an effect from zero, in standard deviations."""
    least = min(0.0 if clear is None else clear[2] for clear in _clearest(evidence.best))
    return Reading(least, text=f"{least:.1f} standard deviations from none")


def most_changed(evidence: LineEvidence) -> Reading | None:
    """Largest ratio of an effect's size from all cables and with one cable left out."""
    candidate, fit = evidence.best, evidence.best.fit
    if len(fit.cables) < 2:
        return Reading(np.inf, text="1 cable")
    without = np.array([fit.without(i) for i in range(len(fit.cables))])
    ratios = []
    for i, zero, _ in filter(None, _clearest(candidate)):
        size = float(fit.theta[i]) - zero
        ratios += [float(v) / size if size != 0.0 else 0.0 for v in without[:, i] - zero]
    factors = [max(v, 1.0 / v) if v > 0.0 else np.inf for v in ratios]
    text = f"{min(ratios, default=1.0):.2f} … {max(ratios, default=1.0):.2f} of it remain"
    return Reading(max(factors, default=1.0), text=text)


def spread_p_value(evidence: LineEvidence) -> Reading | None:
    """Smallest p-value of Cochran's Q for a spread between cables beyond the allowed one."""
    candidate, fit = evidence.best, evidence.best.fit
    values, std = fit.by_cable
    if len(values) < 2:
        return Reading(0.0, text="1 cable")
    readings = []
    for i, zero, _ in filter(None, _clearest(candidate)):
        logarithmic = fit.space.logarithmic[fit.common[i]]
        allowed = evidence.rules.alike * (1.0 if logarithmic else abs(float(fit.theta[i]) - zero))
        spread = Spread.of(values[:, i], np.hypot(std[:, i], allowed))
        text = (
            f"{candidate.names[i]} differs by {spread.tau:.2g} beyond a tenth of it, which is "
            f"allowed: Q {spread.q:.1f} of {spread.dof}, p = {spread.p_value:.1g}"
        )
        readings.append(Reading(spread.p_value, text=text))
    none_fitted = Reading(1.0, text="no strength is fitted")
    return min(readings, key=lambda r: r.value, default=none_fitted)


def _as_for_a_study(
    name: str,
    statistic: Callable[[LineEvidence], Reading | None],
    failed: str,
    question: str | None = None,
) -> Check[LineEvidence]:
    """A check of a diagnosis, for many cables: with another statistic and another sentence."""
    (c,) = [check for check in CHECKS if check.name == name]
    question = c.question if question is None else question
    return Check(name, question, c.unit, statistic, c.passes, c.limit, c.failing, failed, c.reason)


LEARNING: tuple[Check[LineEvidence], ...] = (
    _as_for_a_study(
        "fitted_error",
        error_ratio,
        "The model misses more than noise.",
        "Is the error on all cables as small as the noise?",
    ),
    Check(
        "ends_beyond",
        "Are the cables' tips measured where the model predicts them?",
        "standard deviations",
        ends_beyond,
        "<=",
        "chance",
        "unexplained",
        "All cables' ends are seen elsewhere along the cable than the model has them.",
        "the mean over cables; a single one may be seen 0.05 mm further along in all its pictures",
    ),
    _as_for_a_study("ties", most_tied, "These cycles cannot tell them apart."),
    _as_for_a_study(
        "noise_unknown",
        noise_range,
        "The frames at rest are too few to decide whether the error is noise.",
    ),
)


def learning_outcomes(result: LearningResult) -> list[CheckOutcome[LineEvidence]]:
    """Results of all checks of a learning result."""
    return [check.evaluate(LineEvidence(result)) for check in LEARNING]


def learning_verdict(
    result: LearningResult, outcomes: Sequence[CheckOutcome[LineEvidence]]
) -> Verdict:
    """The verdict on a learning result; not `complete` if the search omitted effects."""
    verdict = worst_verdict(outcomes, result.best is None)
    return "cannot_tell" if verdict == "complete" and result.left_out else verdict


GATES: tuple[Check[LineEvidence], ...] = (
    Check(
        "enough forecasts",
        "How many forecasts test the candidate?",
        "forecasts",
        forecast_count,
        ">=",
        "fewest",
        "refused",
        "There are too few forecasts of unseen motions.",
        "their number: of fewer than three a single one decides",
    ),
    Check(
        "forecasts unseen cables better",
        "Are unseen cables forecast better?",
        "p",
        gain_p_value,
        "<=",
        "significance",
        "refused",
        "Unseen cables are not forecast better, or not by enough to matter.",
        "Wilcoxon's test over all frames, and the error in the destination: 10 % and 10 µm less",
    ),
    Check(
        "worst case no worse",
        "By how much is the worst forecast worse?",
        "m",
        worst_change,
        "<=",
        "repeatability_m",
        "refused",
        "The worst forecast becomes worse.",
        "the largest error; arm and camera repeat to 0.1 mm",
    ),
    Check(
        "as many would have passed",
        "How many fewer forecasts pass the opening than before?",
        "forecasts",
        lost_passages,
        "<=",
        "lost_passages",
        "refused",
        "Fewer forecasts are within the opening.",
        "their number before and after",
    ),
    Check(
        "inside physical bounds",
        "How many parameters are at a bound?",
        "parameters",
        at_bound,
        "<=",
        "at_bound",
        "refused",
        "A parameter is at its bound: the value comes from the bound.",
        "their number",
    ),
    Check(
        "identifiable",
        "How many standard deviations is each effect from zero?",
        "standard deviations",
        least_stds,
        ">=",
        "identifiable",
        "refused",
        "The effect does not stand out of its uncertainty.",
        "the amplitude of each effect that is clearest (Wald)",
    ),
    Check(
        "whichever cable is left out",
        "By what factor does the effect change without one cable?",
        "factor",
        most_changed,
        "<",
        "stays_within",
        "refused",
        "The effect rests on a single cable.",
        "the jackknife, to first order",
    ),
    Check(
        "all cables have it alike",
        "Do all cables have the same effect?",
        "p",
        spread_p_value,
        ">=",
        "heterogeneous",
        "refused",
        "Cables differ in the effect by more than a tenth of it.",
        "Cochran's Q (Cochran 1954, Biometrics 10, 101) beyond a tenth of the effect",
    ),
)


def gate_outcomes(evidence: LineEvidence) -> list[CheckOutcome[LineEvidence]]:
    """Results of all gates that apply to a candidate."""
    outcomes = [gate.evaluate(evidence) for gate in GATES]
    return [outcome for outcome in outcomes if outcome.passed is not None]
