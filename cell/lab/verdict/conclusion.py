"""Conclusion of a diagnosis: verdict, claimed effects, ranking and doubts."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cell.files.words import counted
from cell.lab.data.check import CheckOutcome, worst_verdict
from cell.lab.data.prepared import PreparedStudy
from cell.lab.data.results import (
    Diagnosis,
    Doubt,
    Errors,
    MissingEffect,
    Nearest,
    RankedEffect,
    RemainingError,
    Status,
    Verdict,
)
from cell.lab.data.work import SpentError, WorkStoppedError
from cell.lab.fit.score_test import ScreenedEffect, holm
from cell.lab.search.effect_search import SearchResult
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import (
    FittedModel,
    added_effect,
    at_bound,
    error_over_noise,
    peak,
    residual_summary,
)
from cell.lab.search.partial import PartialExplanation, step_p
from cell.lab.strength.estimate import estimate
from cell.lab.verdict.doubts import doubts, ended_doubt, is_meaningless
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.ties import tied_so_far
from cell.study.independence import Independence

_LOG = logging.getLogger(__name__)

#: Errors of a model that was not fitted to the fit trials alone.
NOT_FITTED = Errors(float("nan"), float("nan"))


@dataclass(frozen=True, eq=False)
class Examination:
    """A diagnosis and the fits behind it, for the report.

    fits      the models that were fitted
    path      the baseline, then with each effect added in the order of `diagnosis.missing`
    singles   the baseline with each effect that was worth a fit
    accepted  the model with every significant and confirmed effect, even if it does not explain all
    final     the model that explains most: with `diagnosis.missing`, or else `diagnosis.partial`
    final_prepared  the study as `final` was fitted to it
    partial   the same as `path` for `diagnosis.partial`
    """

    diagnosis: Diagnosis
    fits: FitCache
    path: tuple[FittedModel, ...]
    singles: tuple[FittedModel, ...]
    accepted: FittedModel
    final: FittedModel
    final_prepared: PreparedStudy
    partial: tuple[FittedModel, ...]


def conclude(
    search: SearchResult,
    evidence: Evidence,
    checks: Sequence[CheckOutcome[Evidence]],
    path: Sequence[FittedModel],
    partial: PartialExplanation | None,
    *,
    all_tried: bool,
) -> Examination:
    """The diagnosis: its verdict, effects, checks and doubts.

    evidence   of the model that the search accepted
    checks     their outcomes
    path       the baseline, then with each effect of that model; the baseline alone if it does not
               explain the study
    partial    the nearest explanation if the model does not explain the study
    all_tried  nothing that could change a claim was left out because the budget was spent
    """
    fits, base, tied = evidence.fits, evidence.base, evidence.tied
    verdict = worst_verdict(checks, evidence.is_base)
    if not all_tried and verdict != "complete":
        verdict = "cannot_tell"
    _LOG.info("verdict: %s", verdict)
    nearest_of = partial or PartialExplanation(fits, search.singles, (base,))
    joint, steps = nearest_of.fits, nearest_of.path
    final = evidence.final if partial is None else steps[-1]
    ties_of = {e.name: tied_so_far(joint, steps[-1], e) for e in joint.added(steps[-1])}
    rivals = {n for names in (*tied.values(), ties_of, *ties_of.values()) for n in names}
    diagnosis = Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=(base if verdict == "complete" else fits.prior_candidate()).errors,
        verdict=verdict,
        missing=added_effects(fits, path, tied),
        ranking=ranked(fits, path[-1], search.singles, rivals),
        left=remaining_error(joint, steps[0], final),
        partial=added_effects(joint, steps, ties_of),
        nearest=() if partial is None else nearest(partial, sound(search.singles, base)),
        warnings=(
            *doubts(fits, joint, final),
            *(doubt for outcome in checks for doubt in outcome.warnings(evidence)),
        ),
        checks=tuple(outcome.result for outcome in checks),
        independence=evidence.independence,
        knots=base.fit.space.knots,
        fit_errors=fits.work.fit_errors,
    )
    return Examination(
        diagnosis, fits, tuple(path), search.singles, evidence.final, final, joint.prepared, steps
    )


def ended_early(fits: FitCache, error: WorkStoppedError) -> Examination:
    """The diagnosis if a person stops it or its work is spent; no effect is confirmed."""
    base = fits.base
    tried = sum(len(c.names) == len(base.names) + 1 for c in fits.known())
    doubt = ended_doubt(
        isinstance(error, SpentError),
        f"{counted(tried, 'effect was', 'effects were')} fitted so far, nothing is confirmed",
    )
    return unconfirmed(fits, "cannot_tell", doubt)


def unconfirmed(fits: FitCache, verdict: Verdict, why: Doubt) -> Examination:
    """The diagnosis without a completed search; no effect is confirmed."""
    base = fits.base
    singles = tuple(c for c in fits.known() if len(c.names) == len(base.names) + 1)
    partial = PartialExplanation(fits, singles, (base,))
    fits.screened(base)
    searched = why.code != "not_searched"
    diagnosis = Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=base.errors,
        verdict=verdict,
        ranking=ranked(fits, base, singles, set()) if searched else (),
        left=remaining_error(fits, base, base),
        nearest=nearest(partial, sound(singles, base)),
        warnings=(why, *(d for d in doubts(fits, fits, base) if d.code != why.code)),
        independence=Independence.of(fits.prepared.study),
        knots=base.fit.space.knots,
        fit_errors=fits.work.fit_errors,
    )
    return Examination(diagnosis, fits, (base,), singles, base, base, fits.prepared, ())


def sound(singles: Sequence[FittedModel], base: FittedModel) -> list[FittedModel]:
    """The models whose fit is no worse than without their effect; others have not converged."""
    return [c for c in singles if c.fit.objective <= base.fit.objective]


def added_effects(
    fits: FitCache, steps: Sequence[FittedModel], tied: Mapping[str, Sequence[str]]
) -> tuple[MissingEffect, ...]:
    """The effects that the steps after the first one have added, with their evidence.

    Their p is multiplied by the number of effects tried (Bonferroni); it is printed, and differs
    from the Holm-corrected one by which `effect_search` has added them.
    """
    if len(steps) == 1:
        return ()
    final, missing = estimate(fits.prepared, steps[-1].fit, fits.library.values()), []
    for small, large in itertools.pairwise(steps):
        effect, gain = added_effect(small, large), fits.gain(small, large)
        p_value = gain.p_value
        if error_over_noise(fits.prepared, large) > fits.rules.most_over_noise:
            p_value = max(p_value, step_p(fits, small, large))
        missing.append(
            MissingEffect(
                effect=effect.name,
                tied_with=tuple(tied.get(effect.name, ())),
                p_value=min(1.0, p_value * (fits.tried - len(small.effects))),
                delta_bic=gain.delta_bic,
                parameters=final.intervals(effect),
                errors=large.errors,
                explained_share=fits.removed_share(steps[0], large),
            )
        )
    return tuple(missing)


def ranked(
    fits: FitCache, final: FittedModel, singles: Sequence[FittedModel], rivals: set[str]
) -> tuple[RankedEffect, ...]:
    """All effects, ranked by the evidence for each as the only addition to the baseline.

    None is absent given a final model whose parameters mean nothing.
    """
    base = fits.base
    refits = {c.effects[-1].name: c for c in sound(singles, base)}
    rows = []
    for screened in fits.screened(base):
        name = screened.effect.name
        if name in refits:
            gain = fits.gain(base, refits[name])
            rows.append((name, gain.delta_chi2, gain.p_value, refits[name].evidence))
        else:
            rows.append((name, screened.score.statistic, screened.score.p_value, -np.inf))
    adjusted = holm([row[2] for row in rows])
    at_end = {s.effect.name: s for s in fits.screened(final)}
    at_end_p = dict(zip(at_end, holm([s.score.p_value for s in at_end.values()]), strict=True))
    excludes = not is_meaningless(fits, final)
    ranked = []
    order = sorted(zip(rows, adjusted, strict=True), key=lambda r: (-r[0][3], -r[0][1]))
    for (name, score, _, _), p_value in order:
        status: Status
        if name in final.names:
            status = "present"
        elif name in rivals or at_end_p[name] < fits.rules.significance:
            status = "inspect"
        else:
            excluded = excludes and _too_small(at_end[name])
            status = "absent" if excluded else "cannot_tell"
        ranked.append(RankedEffect(name, float(score), p_value, status))
    return tuple(ranked)


def _too_small(screened: ScreenedEffect) -> bool:
    """Whether every amplitude is well below the typical one, which would have been detected."""
    score = screened.score
    reach = np.abs(score.amplitude) + 1.96 * score.std
    sizes = [abs(p.starts[0] - p.default) for p in screened.effect.parameters if p.amplitude]
    return bool(np.all(reach < np.array(sizes)))


def nearest(partial: PartialExplanation, fitted: Sequence[FittedModel]) -> tuple[Nearest, ...]:
    """The single effects with the smallest residual over all trials: its size and place.

    fitted  the same fitted to the fit trials alone: their errors are those of a forecast
    """
    fits, base = partial.fits, partial.path[0]
    rms_m = {c.names: residual_summary(fits.prepared, c).rms_m for c in partial.singles}
    best = sorted(partial.singles, key=lambda c: rms_m[c.names])
    refitted = {c.names: c for c in fitted}
    return tuple(
        Nearest(
            effect=(effect := added_effect(base, candidate).name),
            explained_share=fits.removed_share(base, candidate),
            left_rms_m=rms_m[candidate.names],
            errors=refitted[candidate.names].errors if candidate.names in refitted else NOT_FITTED,
            peak=peak(fits.prepared, candidate),
            at_bound=tuple(
                f"{name} {value:.3g} {unit}"
                for name, value, unit in at_bound(candidate.fit)
                if name.startswith(f"{effect}.")
            ),
        )
        for candidate in best[: fits.rules.most_named]
    )


def remaining_error(fits: FitCache, base: FittedModel, final: FittedModel) -> RemainingError:
    """Residual of a model: its size, the explained share of the baseline's error, its place."""
    before, after = (residual_summary(fits.prepared, model) for model in (base, final))
    return RemainingError(
        rms_m=after.rms_m,
        before_rms_m=before.rms_m,
        over_noise=after.rms_m / fits.prepared.noise_model.noise.std_m,
        explained_share=fits.removed_share(base, final),
        peak=peak(fits.prepared, final),
    )
