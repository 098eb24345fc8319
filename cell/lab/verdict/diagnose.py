"""Diagnosis: a search for what the model lacks, the checks of what it leaves, and a verdict."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from cell.identify.gauss_newton import UnsimulatedError
from cell.lab.data.prepared import PreparedStudy, StoppedError
from cell.lab.data.results import Diagnosis, Doubt, Verdict
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.search.screen import ScreenedEffect
from cell.lab.verdict.checks import answers, explains, verdict_of
from cell.lab.verdict.doubts import (
    doubts,
    interrupted_doubt,
    is_no_model,
    no_model_doubt,
    unsimulated_doubt,
)
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.forward_search import (
    errors_in_words,
    searched,
    steps_to,
    with_ties,
)
from cell.lab.verdict.nearest import nearest, tied_so_far, what_is_left
from cell.lab.verdict.partial import Partial, explain_partly
from cell.lab.verdict.ranking import all_found, ranked, sound
from cell.lab.verdict.thresholds import DEFAULT_RULES, Rules

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Examination:
    """A diagnosis and the fits behind it, for the report.

    steps     the baseline, then with each effect added in the order of `diagnosis.missing`
    accepted  with every effect that is significant and confirmed, even if they do not explain all
    final     the model that explains most: with `diagnosis.missing` in, or else `diagnosis.partial`
    weighed   the study as `final` was fitted to it
    partial   the same as `steps` for `diagnosis.partial`
    """

    diagnosis: Diagnosis
    steps: tuple[FittedModel, ...]
    screened: tuple[ScreenedEffect, ...]
    singles: tuple[FittedModel, ...]
    accepted: FittedModel
    final: FittedModel
    weighed: PreparedStudy
    partial: tuple[FittedModel, ...] = ()


def diagnose(fits: FitCache, rules: Rules = DEFAULT_RULES) -> Examination:
    """Which effects the model lacks.

    Forward: the effect with the most evidence is added while it is significant and confirmed on
    held-out trials.  Then every effect found is exchanged for every other while that brings
    evidence, and each is tested again with all others in.

    raises  StoppedError, UnsimulatedError: before the baseline was fitted; later, what is known is
            returned
    """
    try:
        return _examined(fits, rules)
    except StoppedError:
        if not fits.recall():
            raise
        fits.prepared.work.stopped = False
        return _so_far(fits, rules)
    except UnsimulatedError:
        if not fits.recall():
            raise
        base = fits.baseline()
        return _unsearched(fits, base, rules, "cannot_tell", unsimulated_doubt())


def _examined(fits: FitCache, rules: Rules) -> Examination:
    base = fits.baseline()
    _LOG.info("study %s, baseline: %s", fits.prepared.study.name, errors_in_words(base))
    if is_no_model(fits, base.fit):
        return _unsearched(fits, base, rules, "unexplained", no_model_doubt())
    screened = fits.screened(base)
    singles = fits.fit_extended(base, fits.shortlist(base, rules.max_refits))
    current, cut_short = searched(fits, base, len(screened), rules)
    if current is not base and fits.settle_mesh(current):
        return _examined(fits, rules)
    found = explains(Evidence(fits, base, current, rules))
    tied: dict[str, tuple[str, ...]] = {}
    steps: tuple[FittedModel, ...] = (base,)
    partial = Partial(fits, tuple(singles), (base,))
    if found:
        current, tied = with_ties(fits, base, current, rules)
        steps = steps_to(fits, current, rules)
    else:
        partial = explain_partly(fits, fits.known(), len(screened), rules)
    evidence = Evidence(fits, base, current, rules, tied)
    asked = tuple(answers(evidence))
    verdict = verdict_of(asked, evidence.is_base)
    rivals = {n for names in tied.values() for n in names}
    whole, most = partial.fits, partial.steps
    also = {e.name: tied_so_far(whole, most[-1], e, rules) for e in whole.added(most[-1])}
    final = current if found else most[-1]
    _LOG.info("verdict: %s", verdict)
    rivals |= {n for effect, names in also.items() for n in (effect, *names)}
    diagnosis = Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=(base if verdict == "complete" else fits.prior_candidate()).errors,
        verdict=verdict,
        missing=all_found(fits, steps, tied, len(screened), rules),
        ranking=ranked(fits, base, steps[-1], singles, rivals, rules),
        left=what_is_left(whole, most[0], final),
        partial=all_found(whole, most, also, len(screened), rules),
        nearest=() if found else nearest(partial, sound(singles, base), rules),
        warnings=(
            *doubts(fits, whole, final, cut_short),
            *(doubt for answer in asked for doubt in answer.warnings(evidence)),
        ),
        checks=tuple(answer.result(evidence) for answer in asked),
    )
    return Examination(
        diagnosis, steps, tuple(screened), tuple(singles), current, final, whole.prepared, most
    )


def _so_far(fits: FitCache, rules: Rules) -> Examination:
    """What is known of a study when its diagnosis is stopped, nothing of it confirmed."""
    base = fits.baseline()
    tried = sum(len(c.names) == len(base.names) + 1 for c in fits.known())
    doubt = interrupted_doubt(f"{tried} effects were fitted so far, nothing is confirmed")
    return _unsearched(fits, base, rules, "cannot_tell", doubt)


def _unsearched(
    fits: FitCache, base: FittedModel, rules: Rules, verdict: Verdict, why: Doubt
) -> Examination:
    """What is known of a study without a search, or before its end; nothing of it is confirmed."""
    one_more = len(base.names) + 1
    singles = tuple(c for c in fits.known() if len(c.names) == one_more)
    partial = Partial(fits, singles, (base,))
    screened = tuple(fits.screened(base))
    searched = why.code != "not_searched"
    diagnosis = Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=base.errors,
        verdict=verdict,
        ranking=ranked(fits, base, base, singles, set(), rules) if searched else (),
        left=what_is_left(fits, base, base),
        nearest=nearest(partial, sound(singles, base), rules),
        warnings=(
            why,
            *doubts(fits, fits, base, cut_short=False),
        ),
    )
    return Examination(diagnosis, (base,), screened, singles, base, base, fits.prepared)
