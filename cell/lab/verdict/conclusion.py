"""Conclusion of a diagnosis: verdict, claimed effects, ranking and doubts."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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
from cell.lab.data.thresholds import Rules
from cell.lab.data.work import SpentError, WorkStoppedError
from cell.lab.fit.plausibility import at_bound
from cell.lab.fit.score_test import holm
from cell.lab.search.effect_search import SearchResult
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel, error_over_noise
from cell.lab.search.partial import PartialExplanation
from cell.lab.search.residual_summary import peak, removed_share, residual_summary
from cell.lab.search.rivals import added_effect, chance_of
from cell.lab.search.screen import ScreenedEffect
from cell.lab.strength.estimate import ParameterEstimate, estimate
from cell.lab.verdict.doubts import doubts, ended_doubt, is_meaningless
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.ties import tied_so_far
from cell.study.independence import Independence

_LOG = logging.getLogger(__name__)

#: Errors of what was not fitted to the fit trials alone.
NOT_FITTED = Errors(float("nan"), float("nan"))


@dataclass(frozen=True, eq=False)
class Examination:
    """A diagnosis and the fits behind it, for the report.

    fits      the models that were fitted
    path      the baseline, then with each effect added in the order of `diagnosis.missing`
    singles   the baseline with each effect that was worth a fit
    accepted  with every effect that is significant and confirmed, even if they do not explain all
    final     the model that explains most: with `diagnosis.missing` in, or else `diagnosis.partial`
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
    partial    what comes nearest where the model does not explain the study
    all_tried  nothing that could change a claim was left out because the budget was spent
    """
    fits, base, rules = evidence.fits, evidence.base, evidence.rules
    library, tied = len(fits.screened(base)), evidence.tied
    verdict = worst_verdict(checks, evidence.is_base)
    if not all_tried and verdict != "complete":
        verdict = "cannot_tell"
    _LOG.info("verdict: %s", verdict)
    nearest_of = partial or PartialExplanation(fits, search.singles, (base,))
    joint, most = nearest_of.fits, nearest_of.path
    final = evidence.final if partial is None else most[-1]
    also = {e.name: tied_so_far(joint, most[-1], e, rules) for e in joint.added(most[-1])}
    rivals = {n for names in (*tied.values(), also, *also.values()) for n in names}
    diagnosis = Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=(base if verdict == "complete" else fits.prior_candidate()).errors,
        verdict=verdict,
        missing=added_effects(fits, path, tied, library, rules),
        ranking=ranked(fits, path[-1], search.singles, rivals, rules),
        left=remaining_error(joint, most[0], final),
        partial=added_effects(joint, most, also, library, rules),
        nearest=() if partial is None else nearest(partial, sound(search.singles, base), rules),
        warnings=(
            *doubts(fits, joint, final),
            *(doubt for outcome in checks for doubt in outcome.warnings(evidence)),
        ),
        checks=tuple(outcome.result for outcome in checks),
        independence=evidence.independence,
        knots=base.fit.space.knots,
    )
    return Examination(
        diagnosis, fits, tuple(path), search.singles, evidence.final, final, joint.prepared, most
    )


def interrupted(fits: FitCache, rules: Rules, error: WorkStoppedError) -> Examination:
    """The diagnosis of a study that was stopped early; no effect is confirmed."""
    base = fits.base
    tried = sum(len(c.names) == len(base.names) + 1 for c in fits.known())
    doubt = ended_doubt(
        isinstance(error, SpentError),
        f"{counted(tried, 'effect was', 'effects were')} fitted so far, nothing is confirmed",
    )
    return unconfirmed(fits, rules, "cannot_tell", doubt)


def unconfirmed(fits: FitCache, rules: Rules, verdict: Verdict, why: Doubt) -> Examination:
    """The diagnosis without a completed search; no effect is confirmed."""
    base = fits.base
    one_more = len(base.names) + 1
    singles = tuple(c for c in fits.known() if len(c.names) == one_more)
    partial = PartialExplanation(fits, singles, (base,))
    fits.screened(base)
    searched = why.code != "not_searched"
    diagnosis = Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=base.errors,
        verdict=verdict,
        ranking=ranked(fits, base, singles, set(), rules) if searched else (),
        left=remaining_error(fits, base, base),
        nearest=nearest(partial, sound(singles, base), rules),
        warnings=(
            why,
            *(d for d in doubts(fits, fits, base) if d.code != why.code),
        ),
        independence=Independence.of(fits.prepared.study),
        knots=base.fit.space.knots,
    )
    return Examination(diagnosis, fits, (base,), singles, base, base, fits.prepared, ())


def sound(singles: Sequence[FittedModel], base: FittedModel) -> list[FittedModel]:
    """The models whose fit is no worse than without their effect; others have not converged."""
    return [c for c in singles if c.fit.objective <= base.fit.objective]


def added_effects(
    fits: FitCache,
    steps: Sequence[FittedModel],
    tied: Mapping[str, Sequence[str]],
    library: int,
    rules: Rules,
) -> tuple[MissingEffect, ...]:
    """The effects that the steps after the first one have added, with their evidence."""
    if len(steps) == 1:
        return ()
    final = estimate(fits.prepared, steps[-1].fit, fits.library.values())
    noise_m = fits.prepared.noise_model.noise.std_m
    left = [residual_summary(fits.prepared, c) for c in steps]
    return tuple(
        replace(
            _added_effect(fits, small, large, tied, library, final, rules),
            explained_share=removed_share(noise_m, left[0], after),
        )
        for (small, large), after in zip(itertools.pairwise(steps), left[1:], strict=True)
    )


def _added_effect(
    fits: FitCache,
    small: FittedModel,
    large: FittedModel,
    tied: Mapping[str, Sequence[str]],
    library: int,
    final: ParameterEstimate,
    rules: Rules,
) -> MissingEffect:
    effect = added_effect(small, large)
    gain = fits.gain(small, large)
    p_value = gain.p_value
    if error_over_noise(fits.prepared, large) > rules.most_over_noise:
        p_value = max(p_value, chance_of(fits, small, large))
    return MissingEffect(
        effect=effect.name,
        tied_with=tuple(tied.get(effect.name, ())),
        p_value=min(1.0, p_value * (library - len(small.effects))),
        delta_bic=gain.delta_bic,
        parameters=final.intervals(effect),
        errors=large.errors,
    )


def ranked(
    fits: FitCache,
    final: FittedModel,
    singles: Sequence[FittedModel],
    rivals: set[str],
    rules: Rules,
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
    left = dict(zip(at_end, holm([s.score.p_value for s in at_end.values()]), strict=True))
    excludes = not is_meaningless(fits, final)
    ranked = []
    order = sorted(zip(rows, adjusted, strict=True), key=lambda r: (-r[0][3], -r[0][1]))
    for (name, score, _, _), p_value in order:
        status: Status
        if name in final.names:
            status = "present"
        elif name in rivals or left[name] < rules.significance:
            status = "inspect"
        else:
            excluded = excludes and _too_small(at_end[name])
            status = "absent" if excluded else "cannot_tell"
        ranked.append(RankedEffect(name, float(score), p_value, status))
    return tuple(ranked)


def _too_small(screened: ScreenedEffect) -> bool:
    """Whether an effect of typical size would have been seen: every amplitude is well below it."""
    score = screened.score
    reach = np.abs(score.amplitude) + 1.96 * score.std
    sizes = [abs(p.starts[0] - p.default) for p in screened.effect.parameters if p.amplitude]
    return bool(np.all(reach < np.array(sizes)))


def nearest(
    partial: PartialExplanation, tried: Sequence[FittedModel], rules: Rules
) -> tuple[Nearest, ...]:
    """The single effects with the smallest residual over all trials: its size and place.

    tried  the same fitted to the fit trials alone: their errors are what a forecast would have
    """
    prepared = partial.fits.prepared
    base = partial.path[0]
    before = residual_summary(prepared, base)
    best = sorted(
        ((residual_summary(prepared, c), c) for c in partial.singles),
        key=lambda pair: pair[0].mean_square_m2,
    )
    strict = {c.names: c for c in tried}
    return tuple(
        Nearest(
            effect=added_effect(base, candidate).name,
            explained_share=removed_share(prepared.noise_model.noise.std_m, before, after),
            left_rms_m=after.rms_m,
            errors=strict[candidate.names].errors if candidate.names in strict else NOT_FITTED,
            peak=peak(prepared, candidate),
            at_bound=_at_bound(candidate, added_effect(base, candidate).name),
        )
        for after, candidate in best[: rules.most_named]
    )


def _at_bound(candidate: FittedModel, effect: str) -> tuple[str, ...]:
    """Parameters of an effect that are at a bound, with their values."""
    return tuple(
        f"{name} {value:.3g} {unit}"
        for name, value, unit in at_bound(candidate.fit)
        if name.startswith(f"{effect}.")
    )


def remaining_error(fits: FitCache, base: FittedModel, final: FittedModel) -> RemainingError:
    """Residual of a model: its size, the explained share of the baseline's error, its place."""
    prepared = fits.prepared
    noise_m = prepared.noise_model.noise.std_m
    before, after = residual_summary(prepared, base), residual_summary(prepared, final)
    return RemainingError(
        rms_m=after.rms_m,
        before_rms_m=before.rms_m,
        over_noise=after.rms_m / noise_m,
        explained_share=removed_share(noise_m, before, after),
        peak=peak(prepared, final),
    )
