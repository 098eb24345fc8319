"""Additions to a diagnosis: limits of other effects, and agreement of the trials."""

from __future__ import annotations

from dataclasses import replace

from cell.identify.gauss_newton import UNSIMULATED
from cell.lab.data.results import Limit
from cell.lab.data.work import SpentError, WorkStoppedError
from cell.lab.fit.all_trials_fit import AllTrialsFit, of_all_trials
from cell.lab.strength.limits import limits
from cell.lab.strength.trial_agreement import agreement
from cell.lab.verdict.diagnose import Examination
from cell.lab.verdict.doubts import ended_doubt
from cell.lab.verdict.fit_doubts import MEANINGLESS

#: What is left out where there is no time for it.
_LIMITS = "how strong other effects could be was not computed"
_AGREEMENT = "whether the trials agree was not computed"


def with_limits(examination: Examination) -> Examination:
    """The examination with limits of every effect that was tried and is neither named nor tied.

    None of an unexplained study: beside a wrong model the true effect would be excluded; nor beside
    one whose parameters mean nothing.  None, and a warning, where there is no time for them.
    """
    diagnosis, work = examination.diagnosis, examination.fits.work
    if diagnosis.verdict == "unexplained" or diagnosis.codes & {"interrupted", *MEANINGLESS}:
        return examination
    try:
        with work.stage("strength"):
            if work.spent:
                return _without(examination, _LIMITS, spent=True)
            found = _limits(examination)
    except WorkStoppedError as error:
        work.conclude()
        return _without(examination, _LIMITS, spent=isinstance(error, SpentError))
    return replace(examination, diagnosis=replace(diagnosis, limits=found))


def _without(examination: Examination, what: str, *, spent: bool) -> Examination:
    """The examination with a warning of what is missing."""
    diagnosis = examination.diagnosis
    warnings = (*diagnosis.warnings, ended_doubt(spent, what))
    return replace(examination, diagnosis=replace(diagnosis, warnings=warnings))


def _limits(examination: Examination) -> tuple[Limit, ...]:
    """Limits of what the examination has neither named nor tied."""
    diagnosis, fits = examination.diagnosis, examination.fits
    named = {n for f in (*diagnosis.missing, *diagnosis.partial) for n in (f.effect, *f.tied_with)}
    final = examination.final
    absent = [
        effect
        for name, effect in fits.library.items()
        if name not in named and name not in final.names
    ]
    try:
        whole = of_all_trials(examination.weighed, final.fit)
    except UNSIMULATED:  # as far as the fitted trials tell
        whole = AllTrialsFit(examination.weighed, final.fit)
    return limits(whole, absent, fits.progress)


def with_agreement(examination: Examination) -> Examination:
    """The examination with estimates per trial of the final model's parameters.

    None, and a warning, where there is no time for it; none where no model's parameters mean
    anything.
    """
    diagnosis, fits = examination.diagnosis, examination.fits
    work = fits.work
    if diagnosis.codes & {"interrupted", "not_searched", "hopeless"}:
        return examination
    try:
        with work.stage("strength"):
            if work.spent:
                return _without(examination, _AGREEMENT, spent=True)
            found = agreement(fits.prepared, examination.final.fit, fits.progress)
    except WorkStoppedError as error:
        work.conclude()
        return _without(examination, _AGREEMENT, spent=isinstance(error, SpentError))
    return replace(examination, diagnosis=replace(diagnosis, agreement=found))
