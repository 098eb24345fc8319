"""Additions to a diagnosis: limits of other effects, and agreement of the trials."""

from __future__ import annotations

from dataclasses import replace

from cell.identify.gauss_newton import UNSIMULATED
from cell.lab.data.results import Limit
from cell.lab.data.work import StoppedError
from cell.lab.fit.all_trials_fit import AllTrialsFit, of_all_trials
from cell.lab.strength.limits import limits
from cell.lab.strength.trial_agreement import agreement
from cell.lab.verdict.diagnose import Examination
from cell.lab.verdict.doubts import interrupted_doubt
from cell.lab.verdict.fit_doubts import MEANINGLESS


def with_limits(examination: Examination) -> Examination:
    """The examination with limits of every effect that was tried and is neither named nor tied.

    None of an unexplained study: beside a wrong model the true effect would be excluded; nor beside
    one whose parameters mean nothing.  None, and a warning, where there is no time for them.
    """
    diagnosis = examination.diagnosis
    if diagnosis.verdict == "unexplained" or diagnosis.codes & {"interrupted", *MEANINGLESS}:
        return examination
    try:
        return replace(examination, diagnosis=replace(diagnosis, limits=_limits(examination)))
    except StoppedError:
        examination.fits.work.stopped = False
        doubt = interrupted_doubt("how strong other effects could be was not computed")
        return replace(
            examination, diagnosis=replace(diagnosis, warnings=(*diagnosis.warnings, doubt))
        )


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
    diagnosis = examination.diagnosis
    if diagnosis.codes & {"interrupted", "not_searched", "hopeless"}:
        return examination
    try:
        fits = examination.fits
        found = agreement(fits.prepared, examination.final.fit, fits.progress)
    except StoppedError:
        examination.fits.work.stopped = False
        doubt = interrupted_doubt("whether the trials agree was not computed")
        diagnosis = replace(diagnosis, warnings=(*diagnosis.warnings, doubt))
        return replace(examination, diagnosis=diagnosis)
    return replace(examination, diagnosis=replace(diagnosis, agreement=found))
