"""A diagnosis from top to bottom: which physical effects the model of a cable lacks.

    search      effects added while they are significant and confirmed        `search`
    noise       re-estimated given the final model; search repeated once      `search.fit_cache`
    knots       more of EI(s) where no effect explains as much; repeated      `verdict.knots`
    explain     ties of the effects                                           `verdict.ties`
                or else the best partial explanation                          `search.partial`
    check       the table of checks on the evidence                           `verdict.checks`
    conclude    verdict, claims, doubts                                       `verdict.conclusion`

`FitCache.of` prepares the study before: noise and initial states (`data.prepared`), outliers
(`search.setup`), fit of the baseline (`search.baseline`).  `with_strength` computes limits of the
other effects and agreement of the trials afterwards (`strength`).  `data.work` divides a budget of
simulated time among `STAGES`; if it is spent, `ended_early` concludes with the results so far.
Omitted computations are reported, and claims that they could change are not made.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from cell.identify.gauss_newton import UnsimulatedError
from cell.lab.data.check import CheckOutcome, worst_verdict
from cell.lab.data.work import SpentError, WorkStoppedError
from cell.lab.fit.systematic_error import AllTrialsFit, of_all_trials
from cell.lab.search.effect_search import SearchResult, errors_in_words, search_effects
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import is_no_model
from cell.lab.search.partial import explain_partly
from cell.lab.search.stepwise import in_order
from cell.lab.strength.limits import limits
from cell.lab.strength.trial_agreement import agreement
from cell.lab.verdict.checks import evaluate, explains
from cell.lab.verdict.conclusion import Examination, conclude, ended_early, unconfirmed
from cell.lab.verdict.doubts import MEANINGLESS, NO_MODEL, UNSIMULATED_SEARCH, ended_doubt
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.knots import with_more_knots
from cell.lab.verdict.ties import with_ties

_LOG = logging.getLogger(__name__)

#: Stages of the work: the search is repeated once, with the noise given the first model.
_SEARCHES = ("search", "repeated search")


def diagnose(fits: FitCache) -> Examination:
    """The diagnosis of a prepared study: effects that its model lacks.

    If it is stopped, or nothing more can be simulated, the results so far.
    """
    work, first = fits.work, fits
    usual: _CheckedSearch | None = None
    stage, repeated = _SEARCHES
    try:
        while True:
            _LOG.info(
                "study %s, baseline: %s", fits.prepared.study.name, errors_in_words(fits.base)
            )
            if is_no_model(fits.prepared, fits.base.fit):
                return unconfirmed(fits, "unexplained", NO_MODEL)
            with work.stage(stage):
                search = search_effects(fits)
            stage = repeated
            if search.refined is not None:
                with work.stage(repeated):
                    fits = FitCache.of(search.refined)
                continue
            with work.stage("conclude"):
                checked = _checked(search)
            with work.stage(repeated):
                finer = None if checked.is_complete else with_more_knots(fits, first)
            if finer is None:
                break
            usual, fits = usual or checked, finer
        with work.stage("conclude"):
            return _concluded(checked if usual is None or checked.explained else usual)
    except WorkStoppedError as error:
        work.conclude()
        return ended_early(fits, error)
    except UnsimulatedError:
        return unconfirmed(fits, "cannot_tell", UNSIMULATED_SEARCH)


@dataclass(frozen=True, eq=False)
class _CheckedSearch:
    """A search, the checks of the model that it accepted, and whether that explains the study."""

    search: SearchResult
    evidence: Evidence
    checks: tuple[CheckOutcome[Evidence], ...]
    explained: bool
    all_tried: bool

    @property
    def is_complete(self) -> bool:
        """Whether the verdict on the baseline alone is `complete`."""
        return self.evidence.is_base and worst_verdict(self.checks, is_base=True) == "complete"


def _checked(search: SearchResult) -> _CheckedSearch:
    """A search with the checks of the model that it accepted."""
    fits, left_out = search.fits, search.fits.work.left_out
    evidence = Evidence(fits, search.model)
    explained, before = explains(evidence), len(left_out)
    if explained:
        evidence = with_ties(evidence)
    all_tried = search.all_tried and len(left_out) == before
    return _CheckedSearch(search, evidence, tuple(evaluate(evidence)), explained, all_tried)


def _concluded(checked: _CheckedSearch) -> Examination:
    """The conclusion from a search: effects that explain the study, or a partial explanation."""
    search, evidence, fits = checked.search, checked.evidence, checked.evidence.fits
    partial = None if checked.explained else explain_partly(fits)
    path = [fits.base]
    if checked.explained:  # from the baseline, the effect with the most evidence first
        path = in_order(fits, evidence.final, lambda c: c.evidence)
    return conclude(search, evidence, checked.checks, path, partial, all_tried=checked.all_tried)


def with_strength(examination: Examination) -> Examination:
    """The examination with limits of effects that are not named, and agreement of the trials."""
    return with_agreement(with_limits(examination))


def with_limits(examination: Examination) -> Examination:
    """The examination with limits of every effect that is neither named nor tied.

    Without limits for an unexplained study, where the true effect might be excluded given the wrong
    model, and if the parameters are meaningless.
    """
    diagnosis, fits, final = examination.diagnosis, examination.fits, examination.final
    if diagnosis.verdict == "unexplained" or diagnosis.codes & {"interrupted", *MEANINGLESS}:
        return examination
    named = {n for f in (*diagnosis.missing, *diagnosis.partial) for n in (f.effect, *f.tied_with)}
    absent = [e for name, e in fits.library.items() if name not in named | final.names]
    prepared = examination.final_prepared

    def measure() -> dict[str, Any]:
        # from the fitted trials only, if not all can be simulated
        joint = of_all_trials(prepared, final.fit) or AllTrialsFit(prepared, final.fit)
        return {"limits": limits(joint, absent, fits.progress)}

    return _measured(examination, "how strong other effects could be was not computed", measure)


def with_agreement(examination: Examination) -> Examination:
    """The examination with estimates per trial of the final model's parameters.

    Without them if the parameters are meaningless.
    """
    if examination.diagnosis.codes & {"interrupted", "not_searched", "hopeless"}:
        return examination
    fits, fit = examination.fits, examination.final.fit
    return _measured(
        examination,
        "whether the trials agree was not computed",
        lambda: {"agreement": agreement(fits.prepared, fit, fits.progress)},
    )


def _measured(
    examination: Examination, missing: str, measure: Callable[[], dict[str, Any]]
) -> Examination:
    """The examination with further results; if stopped, with a warning `missing`."""
    diagnosis, work = examination.diagnosis, examination.fits.work
    try:
        with work.stage("strength"):
            spent = work.spent
            if not spent:
                return replace(examination, diagnosis=replace(diagnosis, **measure()))
    except WorkStoppedError as error:
        work.conclude()
        spent = isinstance(error, SpentError)
    warnings = (*diagnosis.warnings, ended_doubt(spent, missing))
    return replace(examination, diagnosis=replace(diagnosis, warnings=warnings))
