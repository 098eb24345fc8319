"""Diagnosis: a search for what the model lacks, the checks of what it leaves, and a verdict."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from cell.files.words import counted
from cell.identify.gauss_newton import UnsimulatedError
from cell.lab.data.check import worst_verdict
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import Diagnosis, Doubt, Verdict
from cell.lab.data.thresholds import DEFAULT_RULES, Rules
from cell.lab.data.work import SpentError, WorkStoppedError
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.search.screen import ScreenedEffect
from cell.lab.verdict.checks import answers, explains
from cell.lab.verdict.doubts import (
    doubts,
    ended_doubt,
    no_model_doubt,
    unsimulated_doubt,
)
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.fit_doubts import is_no_model
from cell.lab.verdict.forward_search import (
    errors_in_words,
    searched,
    steps_to,
    with_ties,
)
from cell.lab.verdict.nearest import nearest, tied_so_far, what_is_left
from cell.lab.verdict.partial import Partial, explain_partly
from cell.lab.verdict.ranking import all_found, ranked, sound

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Examination:
    """A diagnosis and the fits behind it, for the report.

    fits      the models that were fitted
    steps     the baseline, then with each effect added in the order of `diagnosis.missing`
    accepted  with every effect that is significant and confirmed, even if they do not explain all
    final     the model that explains most: with `diagnosis.missing` in, or else `diagnosis.partial`
    weighed   the study as `final` was fitted to it
    partial   the same as `steps` for `diagnosis.partial`
    """

    diagnosis: Diagnosis
    fits: FitCache
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

    Each stage has its share of the budget of `fits.work`.  What is left out because of it is told,
    and then nothing is claimed that it could have changed.

    raises  StoppedError, UnsimulatedError: before the baseline was fitted; later, what is known is
            returned
    """
    searches = [fits]
    try:
        return _examined(searches, rules)
    except WorkStoppedError as error:
        known = _last_known(searches)
        if known is None:
            raise
        fits.work.conclude()
        return _so_far(known, rules, error)
    except UnsimulatedError:
        known = _last_known(searches)
        if known is None:
            raise
        return _unsearched(known, known.baseline(), rules, "cannot_tell", unsimulated_doubt())


def _last_known(searches: Sequence[FitCache]) -> FitCache | None:
    """The last search of which the baseline is known."""
    return next((fits for fits in reversed(searches) if fits.baseline_is_fitted()), None)


def _examined(searches: list[FitCache], rules: Rules) -> Examination:
    """The diagnosis by the last of the searches; one that it needs is added to them."""
    fits = searches[-1]
    work = fits.work
    with work.stage("prepare" if len(searches) == 1 else "repeated search"):
        base = fits.baseline()
    _LOG.info("study %s, baseline: %s", fits.prepared.study.name, errors_in_words(base))
    if is_no_model(fits, base.fit):
        return _unsearched(fits, base, rules, "unexplained", no_model_doubt())
    with work.stage("search" if len(searches) == 1 else "repeated search"):
        screened = fits.screened(base)
        singles = fits.fit_extended(base, fits.shortlist(base, rules.max_refits))
        all_tried = not work.left_out
        found = searched(fits, base, len(screened), rules)
    if found.again is not None:
        searches.append(found.again)
        return _examined(searches, rules)
    with work.stage("conclude"):
        return _concluded(fits, found.model, singles, all_tried, rules)


def _concluded(
    fits: FitCache,
    current: FittedModel,
    singles: Sequence[FittedModel],
    all_tried: bool,
    rules: Rules,
) -> Examination:
    """What may be said of the model that a search ended at; or what comes nearest.

    singles    each effect worth it alone beside the baseline
    all_tried  none of these was left out because the budget was spent
    """
    base, library = fits.baseline(), len(fits.screened(fits.baseline()))
    found = explains(Evidence(fits, base, current, rules))
    tied: dict[str, tuple[str, ...]] = {}
    steps: tuple[FittedModel, ...] = (base,)
    partial = Partial(fits, tuple(singles), (base,))
    if found:
        before = len(fits.work.left_out)
        current, tied = with_ties(fits, base, current, rules)
        all_tried = all_tried and len(fits.work.left_out) == before
        steps = steps_to(fits, current, rules)
    else:
        partial = explain_partly(fits, fits.known(), library, rules)
    final = current if found else partial.steps[-1]
    evidence = Evidence(fits, base, current, rules, tied)
    return Examination(
        diagnosis=_diagnosis(evidence, steps, partial, singles, final, all_tried),
        fits=fits,
        steps=steps,
        screened=tuple(fits.screened(base)),
        singles=tuple(singles),
        accepted=current,
        final=final,
        weighed=partial.fits.prepared,
        partial=partial.steps,
    )


def _diagnosis(
    evidence: Evidence,
    steps: Sequence[FittedModel],
    partial: Partial,
    singles: Sequence[FittedModel],
    final: FittedModel,
    all_tried: bool,
) -> Diagnosis:
    """The verdict with what it rests on; arguments as in `Examination` and `_concluded`."""
    fits, base, rules = evidence.fits, evidence.base, evidence.rules
    library, tied = len(fits.screened(base)), evidence.tied
    asked = tuple(answers(evidence))
    verdict = worst_verdict(asked, evidence.is_base)
    if not all_tried and verdict != "complete":
        verdict = "cannot_tell"
    _LOG.info("verdict: %s", verdict)
    whole, most = partial.fits, partial.steps
    also = {e.name: tied_so_far(whole, most[-1], e, rules) for e in whole.added(most[-1])}
    rivals = {n for names in (*tied.values(), also, *also.values()) for n in names}
    unexplained = final is not evidence.final
    return Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=(base if verdict == "complete" else fits.prior_candidate()).errors,
        verdict=verdict,
        missing=all_found(fits, steps, tied, library, rules),
        ranking=ranked(fits, base, steps[-1], singles, rivals, rules),
        left=what_is_left(whole, most[0], final),
        partial=all_found(whole, most, also, library, rules),
        nearest=nearest(partial, sound(singles, base), rules) if unexplained else (),
        warnings=(
            *doubts(fits, whole, final),
            *(doubt for answer in asked for doubt in answer.warnings(evidence)),
        ),
        checks=tuple(answer.result for answer in asked),
    )


def _so_far(fits: FitCache, rules: Rules, error: WorkStoppedError) -> Examination:
    """What is known of a study when its diagnosis is stopped, nothing of it confirmed."""
    base = fits.baseline()
    tried = sum(len(c.names) == len(base.names) + 1 for c in fits.known())
    doubt = ended_doubt(
        isinstance(error, SpentError),
        f"{counted(tried, 'effect was', 'effects were')} fitted so far, nothing is confirmed",
    )
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
            *(d for d in doubts(fits, fits, base) if d.code != why.code),
        ),
    )
    return Examination(diagnosis, fits, (base,), screened, singles, base, base, fits.prepared)
