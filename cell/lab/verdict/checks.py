"""The checks of a verdict, as one table: the question, the limit, and the effect of a failure.

If a check of the first part fails, the residual is more than noise: `unexplained`.  If a check of
the second part fails, nothing is claimed, and the check says why: `cannot_tell`.  The verdict is
the worst of these (`worst_verdict` in `cell.lab.data.check`, which `learn` uses too).  Text, page,
JSON and the reference in docs print these rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from cell.lab.data.check import Check, CheckOutcome, Reading
from cell.lab.verdict import check_statistics, doubts
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.prior_check import prior_driven_effects

LEAVES_NOISE: tuple[Check[Evidence], ...] = (
    Check(
        "stated_error",
        "Is the error within what the study states?",
        "p",
        check_statistics.within_stated,
        ">=",
        "residual_significance",
        "unexplained",
        "It misses more than the measurement's stated error.",
        "the p-value of χ² of independent values; up to 10 % above it is a model's own error",
    ),
    Check(
        "fitted_error",
        "Is the error on the fitted trials as small as the noise?",
        "error / noise",
        check_statistics.fitted_ratio,
        "<=",
        "most_over_noise",
        "unexplained",
        "It misses more than noise on the trials that it was fitted to.",
        "the ratio of error and noise; converged simulators of one cable differ by less than 10 %",
    ),
    Check(
        "heldout_smooth",
        "Is the slowly varying error on held-out trials noise?",
        "p",
        check_statistics.heldout_smooth,
        ">=",
        "residual_significance",
        "unexplained",
        "The slow error on held-out trials is not noise.",
        "χ² of slow functions of time and place, which contain misfits and little noise",
    ),
    Check(
        "parameter_constancy",
        "Do all trials agree on the parameters?",
        "p",
        check_statistics.parameter_constancy,
        ">=",
        "residual_significance",
        "unexplained",
        "Single trials need different parameters, but one cable has one set.",
        "a score test of parameters per trial: a wrong model needs other values for each motion",
    ),
    Check(
        "wider_law",
        "Does the law of each effect hold?",
        "p",
        check_statistics.wider_law,
        ">=",
        "residual_significance",
        "unexplained",
        "A wider law than the effect's own explains more: the cause is another.",
        "a score test of the wider law's parameters (Lagrange multiplier)",
        doubts.wider_law_doubts,
    ),
    Check(
        "residual_level",
        "Is the error (held out, if any is) as small as the noise?",
        "p",
        check_statistics.residual_level,
        ">=",
        "residual_significance",
        "unexplained",
        "It misses more than noise.",
        "an F test with the frames at rest that determine the noise, or a χ² test",
    ),
    Check(
        "earlier_model",
        "Is most of the earlier model's error explained?",
        "share",
        check_statistics.explained_of_earlier,
        ">",
        "most_share",
        "unexplained",
        "It leaves most of the error of the earlier cable's model.",
        "the explained share; the remainder may be the earlier model's own error",
    ),
)


def _of_noise(evidence: Evidence) -> Iterator[Check[Evidence]]:
    """Checks whether the residual is noise: the lab's own, then the user's."""
    yield from LEAVES_NOISE
    for own in evidence.rules.own:
        yield Check(
            own.name,
            own.question,
            "p",
            partial(_own, name=own.name),
            ">=",
            "residual_significance",
            "unexplained",
            f"What the model leaves is not what noise would leave: {own.question}",
            f"the statistic of {own.file} compared with its values for noise alone, Holm-corrected",
        )


def _own(evidence: Evidence, name: str) -> Reading | None:
    p_values = evidence.own_p_values
    return None if p_values is None else Reading(p_values[name])


def explains(evidence: Evidence) -> bool:
    """Whether the residual passes every check for noise (or for an earlier model's error)."""
    return all(check.evaluate(evidence).passed is not False for check in _of_noise(evidence))


def _prior_driven(evidence: Evidence) -> Reading | None:
    """Number of effects needed only because of the prior, and their names; None without prior.

    It is 0 if there is only one, and the cable agrees with the prior.
    """
    if evidence.fits.prior_q is None or evidence.is_base:
        return None
    effects = prior_driven_effects(evidence, explains)
    return Reading(float(len(effects)), effects)


MAY_BE_CLAIMED: tuple[Check[Evidence], ...] = (
    Check(
        "confirmation",
        "How many independent trials of other motions are held out?",
        "trials",
        check_statistics.heldout_motions,
        ">=",
        "least_heldout",
        "cannot_tell",
        "No trial of another motion is held out: it is not confirmed.",
        "their number without copies and repetitions of what was fitted to: these confirm nothing",
    ),
    Check(
        "heldout_insensitive",
        "Are the held-out trials sensitive to each named effect?",
        "ln LR",
        check_statistics.least_visible,
        ">=",
        "heldout_gain",
        "cannot_tell",
        "The held-out trials cannot show it: it is not confirmed.",
        "expected ln of the likelihood ratio with the effect and with it off, all else as fitted: "
        "no evidence for it, only whether these trials can show it",
        "the held-out trials cannot show {effect}: it explains the trials fitted to, but it is not "
        "confirmed; hold out a trial that can show it",
    ),
    Check(
        "ties",
        "How many effects explain the error equally well?",
        "effects",
        check_statistics.most_tied,
        "<=",
        "most_named",
        "cannot_tell",
        "These motions cannot tell them apart.",
        "their number: up to three candidates can be tested, more cannot",
    ),
    Check(
        "weakly_identified",
        "Would half of the effect be detected?",
        "p",
        check_statistics.detectable_at_half_size,
        "<",
        "significance",
        "cannot_tell",
        "So weak a signal cannot identify its cause.",
        "power: the residual with half of the effect must fail the checks above at 1 %",
        doubts.weak_doubts,
    ),
    Check(
        "prior_driven",
        "How many effects are needed only because of the prior?",
        "effects",
        _prior_driven,
        "<=",
        "max_unconfirmed",
        "cannot_tell",
        "Without the prior the study does not confirm this.",
        "a diagnosis without the prior, as for another cable",
        "{effect} is needed only because of the prior: without the prior, as for another cable, "
        "the study does not confirm {effect}; give the prior of this cable, or none",
    ),
    Check(
        "possibly_omitted",
        "Do all trials together show another effect?",
        "p",
        check_statistics.possibly_omitted,
        ">=",
        "significance",
        "cannot_tell",
        "All trials together show another effect, but the held-out trials do not confirm it.",
        "a score test of each effect of the library (Lagrange multiplier), Holm-corrected",
        doubts.omitted_doubts,
    ),
    Check(
        "noise_unknown",
        "Is the noise known well enough?",
        "mean square ratio",
        check_statistics.noise_range,
        "<",
        "noise_known_within",
        "cannot_tell",
        "The frames at rest are too few to decide whether that is noise.",
        "the largest noise that the rest allows: noise plus an error as large must exceed it",
        doubts.noise_doubts,
    ),
)
CHECKS = (*LEAVES_NOISE, *MAY_BE_CLAIMED)


def evaluate(evidence: Evidence) -> Iterator[CheckOutcome[Evidence]]:
    """Yield the results of the checks that the verdict needs, in order.

    Where a model is far above the noise, the first check that fails is the last one.  Checks of
    what may be claimed are evaluated only if the residual is noise.
    """
    explained = True
    for check in _of_noise(evidence):
        if not explained and evidence.over_noise >= evidence.rules.most_over_noise:
            return
        outcome = check.evaluate(evidence)
        explained &= outcome.passed is not False
        yield outcome
    if explained:
        yield from (check.evaluate(evidence) for check in MAY_BE_CLAIMED)
