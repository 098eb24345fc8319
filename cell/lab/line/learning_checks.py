"""The checks of what was learned from many cables, as two tables of the kind that a diagnosis has.

`LEARNING` asks what may be said of the model: the questions of a diagnosis that make sense for many
cables.  `GATES` asks what a candidate must meet before a line uses it: forecasts of unseen cables.
A diagnosis asks per trial and in p-values of smooth residuals; vision of a line has errors of its
own that are smooth, so that a line is judged by the size of an error and by forecasts.
"""

from __future__ import annotations

from collections.abc import Sequence

from cell.lab.data.check import Check, CheckOutcome, worst_verdict
from cell.lab.data.results import Verdict
from cell.lab.line import learning_questions as questions
from cell.lab.line.learn import LearningResult
from cell.lab.line.learning_questions import LineEvidence

LEARNING: tuple[Check[LineEvidence], ...] = (
    Check(
        "fitted_error",
        "Is the error on all cables that of noise?",
        "error / noise",
        questions.error_ratio,
        "<=",
        "error_over_noise",
        "unexplained",
        "The model misses more than noise.",
        "the ratio of error and noise; converged simulators of one cable differ by less than 10 %",
    ),
    Check(
        "ends_beyond",
        "Are the cables' ends seen where the model has them?",
        "standard deviations",
        questions.ends_beyond,
        "<=",
        "chance",
        "unexplained",
        "All cables' ends are seen elsewhere along the cable than the model has them.",
        "the mean over cables; a single one may be seen 0.05 mm further along in all its pictures",
    ),
    Check(
        "ties",
        "How many effects explain as much?",
        "effects",
        questions.most_tied,
        "<=",
        "most_named",
        "cannot_tell",
        "These cycles cannot tell them apart.",
        "their number: up to three candidates can be tested, more cannot",
    ),
    Check(
        "noise_unknown",
        "Is the noise known well enough?",
        "mean square ratio",
        questions.noise_range,
        "<",
        "noise_known_within",
        "cannot_tell",
        "The frames at rest are too few to decide whether the error is noise.",
        "the largest noise that the rest allows: noise plus an error as large must exceed it",
    ),
)


def learning_outcomes(result: LearningResult) -> list[CheckOutcome[LineEvidence]]:
    """Of every question that is asked of what was learned."""
    return [check.evaluate(LineEvidence(result)) for check in LEARNING]


def learning_verdict(
    result: LearningResult, found: Sequence[CheckOutcome[LineEvidence]]
) -> Verdict:
    """Of what was learned; nothing is complete while effects were left out of the search."""
    verdict = worst_verdict(found, result.best is None)
    return "cannot_tell" if verdict == "complete" and result.left_out else verdict


GATES: tuple[Check[LineEvidence], ...] = (
    Check(
        "enough forecasts",
        "How many forecasts judge the candidate?",
        "forecasts",
        questions.forecast_count,
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
        questions.chance_of_gain,
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
        questions.worst_change,
        "<=",
        "repeatability_m",
        "refused",
        "The worst forecast becomes worse.",
        "the largest error; arm and camera repeat to 0.1 mm",
    ),
    Check(
        "as many would have passed",
        "How many forecasts leave the mouth?",
        "forecasts",
        questions.lost_passages,
        "<=",
        "lost_passages",
        "refused",
        "Fewer forecasts are within the mouth.",
        "their number before and after",
    ),
    Check(
        "inside physical bounds",
        "How many parameters are at a bound?",
        "parameters",
        questions.at_bound,
        "<=",
        "at_bound",
        "refused",
        "A parameter is at its bound: the value comes from the bound.",
        "their number",
    ),
    Check(
        "identifiable",
        "How clear is each effect?",
        "standard deviations",
        questions.least_stds,
        ">=",
        "identifiable",
        "refused",
        "The effect does not stand out of its uncertainty.",
        "the amplitude of each effect that is clearest (Wald)",
    ),
    Check(
        "whichever cable is left out",
        "By what factor does it change without one cable?",
        "factor",
        questions.most_changed,
        "<",
        "stays_within",
        "refused",
        "The effect rests on a single cable.",
        "the jackknife, to first order",
    ),
    Check(
        "all cables have it alike",
        "Do all cables have the effect alike?",
        "p",
        questions.chance_of_spread,
        ">=",
        "heterogeneous",
        "refused",
        "Cables differ in the effect by more than a tenth of it.",
        "Cochran's Q (Cochran 1954, Biometrics 10, 101) beyond a tenth of the effect",
    ),
)


def gate_outcomes(evidence: LineEvidence) -> list[CheckOutcome[LineEvidence]]:
    """Of every condition that applies to a candidate."""
    found = [gate.evaluate(evidence) for gate in GATES]
    return [answer for answer in found if answer.passed is not None]
