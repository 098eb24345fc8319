"""Partial explanations: effects that explain most of an error, with a residual above the noise.

Where no set of effects fits to the noise, the model's own error limits every conclusion.  So it
replaces the noise here, with its correlation.  The model is fitted to all trials jointly: effects
are compared by how much they change the fit, not by their forecasts.  Rivals of a model are those
that explain as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile

import numpy as np
from scipy.special import chdtrc as chi2_sf

from cell.cable.solver import Solver
from cell.identify.noise import Noise
from cell.lab.data.prepared import PreparedStudy, all_fitted, as_measured
from cell.lab.fit.fitting import fit_trials, start_from
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.extension import POLISHED
from cell.lab.search.fit_cache import FitCache, with_lower_baseline
from cell.lab.search.fitted_model import (
    FittedModel,
    added_effect,
    at_bound,
    error_over_noise,
    is_hopeless,
    log_variance_ratio,
    residual_summary,
)
from cell.lab.search.stepwise import exchanged, holm_among, in_order, levels


def close_rivals(
    fits: FitCache, final: FittedModel, rivals: Sequence[FittedModel]
) -> list[FittedModel]:
    """Rivals that explain as much as `final`, all trials together, the best first.

    They are compared by χ² where the residual is noise, and else by the ratio of residual variances
    too, with the residual's correlation: the model's own error limits the comparison.
    """
    rules = fits.rules
    close = {c.names for c in rivals if c.chi2 < final.chi2 + rules.tie_delta_chi2}
    if error_over_noise(fits.prepared, final) > rules.most_over_noise:
        own = residual_summary(fits.prepared, final)
        close |= {
            c.names
            for c in rivals
            if log_variance_ratio(own, residual_summary(fits.prepared, c)) < rules.tie_delta_chi2
        }
    return sorted((c for c in rivals if c.names in close), key=lambda c: c.chi2)


def step_p(fits: FitCache, small: FittedModel, large: FittedModel) -> float:
    """p-value of the fall of the residual by one more effect, over all trials."""
    before, after = (residual_summary(fits.prepared, model) for model in (small, large))
    amplitudes = sum(p.amplitude for p in added_effect(small, large).parameters)
    return float(chi2_sf(amplitudes, max(log_variance_ratio(after, before), 0.0)))


def near_singles(
    fits: FitCache, final: FittedModel, singles: Sequence[FittedModel]
) -> list[FittedModel]:
    """Other single effects near `final`, a single effect whose residual is above the noise.

    A further effect is then missing with each of them, as with `final`.
    """
    prepared, rules = fits.prepared, fits.rules
    mean_square = {c.names: residual_summary(prepared, c).mean_square_m2 for c in singles}
    if mean_square[final.names] < (rules.most_over_noise * prepared.noise_model.noise.std_m) ** 2:
        return []
    nearest = sorted(singles, key=lambda c: mean_square[c.names])[: rules.most_named]
    return [c for c in nearest if c.names != final.names]


def is_at_bound(small: FittedModel, large: FittedModel) -> bool:
    """Whether a parameter of the effect that `large` adds to `small` is at a bound."""
    own = f"{added_effect(small, large).name}."
    return any(name.startswith(own) for name, *_ in at_bound(large.fit))


def any_at_bound(candidate: FittedModel) -> bool:
    """Whether the amplitude of any effect of the model is at a bound."""
    own = tuple(f"{name}." for name in candidate.names)
    return any(name.startswith(own) for name, *_ in at_bound(candidate.fit))


#: A faster solver: its error is far below that of a model that explains a study only in part.
COARSE = Solver(segments=20, step_s=1.5e-3)

#: The fits are repeated with the smallest error so far as noise, if that is below this share of the
#: previous one; at most this often.
REWEIGHTED_BELOW = 0.5
MOST_REWEIGHTINGS = 3


@dataclass(frozen=True, eq=False)
class PartialExplanation:
    """Fits to all trials jointly, whitened by the model's own error.

    fits      of all trials
    singles   the baseline with each single effect that is worth a fit
    path      the baseline, then with each effect that removes most of the remaining error
    """

    fits: FitCache
    singles: tuple[FittedModel, ...]
    path: tuple[FittedModel, ...]


def explain_partly(fits: FitCache) -> PartialExplanation:
    """Explain most of a study that no set of effects explains to its noise.

    The model's own error is estimated by the residual of the best model so far.
    """
    error, lowest = _own_error(fits, fits.known()), fits.base
    least_m = residual_summary(fits.prepared, lowest).rms_m
    for _ in range(MOST_REWEIGHTINGS):
        joint = _with_noise(fits, error)
        if least_m < residual_summary(joint.prepared, joint.base).rms_m:
            # a fit to all trials cannot have a larger residual
            joint = with_lower_baseline(joint, lowest.fit.q, fits.rules.tie_delta_chi2)
        joint, singles = _singles(joint)
        base = joint.base
        lowest, least_m = base, min(least_m, residual_summary(joint.prepared, base).rms_m)
        before, error = error, _own_error(joint, joint.known())
        # The error of a fit that was stuck is not the model's own; with a larger noise the fits
        # converge from any start.
        if error.std_m > REWEIGHTED_BELOW * before.std_m or joint.work.spent:
            break
    steps = _significant_steps(joint, _added(joint, base, singles))
    if len(steps) == 2:
        for rival in near_singles(joint, steps[1], singles):
            joint.extended(rival)
    unfinished = not joint.work.affords("the search for effects that explain most")
    # a hopeless model explains nothing
    if unfinished or is_hopeless(joint.prepared, steps[-1].fit):
        steps = [base]
    return PartialExplanation(joint, tuple(singles), tuple(steps))


def _added(joint: FitCache, base: FittedModel, singles: Sequence[FittedModel]) -> list[FittedModel]:
    """The baseline, then with effects added that each remove most of the error; exchanged."""
    steps: list[FittedModel] = []

    def extended(model: FittedModel) -> Sequence[FittedModel]:
        return singles if model is base else joint.extended(model)

    def select(model: FittedModel, options: Sequence[FittedModel]) -> list[FittedModel]:
        step = largest_step(joint, model, options)
        return [] if step is None else [step]

    for (model,) in levels(base, extended, select):
        steps.append(model)
        if len(steps) == joint.rules.most_named:
            break
    if len(steps) < 3:
        return steps
    prepared = joint.prepared

    def mean_square(model: FittedModel) -> float:
        return residual_summary(prepared, model).mean_square_m2

    def better(
        without: FittedModel, options: Sequence[FittedModel], model: FittedModel
    ) -> FittedModel | None:
        sound = [c for c in options if not is_at_bound(without, c)]
        best = min(sound, key=mean_square, default=None)
        return best if best is not None and mean_square(best) < mean_square(model) else None

    def in_time() -> bool:
        return prepared.work.affords("the exchange of effects that explain most")

    final = exchanged(joint, steps[-1], better, in_time)
    return in_order(joint, final, lambda c: -mean_square(c))


def _singles(joint: FitCache) -> tuple[FitCache, list[FittedModel]]:
    """The fits, and converged models of the baseline with each single effect worth a fit.

    The baseline is also refitted from the best of them, so that an effect is compared with the best
    model without it.
    """
    singles: list[FittedModel] = []
    for _ in range(MOST_REWEIGHTINGS):
        base = joint.base
        singles = _converged(joint, base, joint.extended(base))
        best = largest_step(joint, base, singles)
        if best is None:
            break
        if joint.work.spent:
            break
        lower = with_lower_baseline(
            joint, start_from(best.fit, base.fit.space), joint.rules.tie_delta_chi2
        )
        if lower is joint:
            break
        joint = lower
    return joint, singles


def _significant_steps(fits: FitCache, steps: Sequence[FittedModel]) -> list[FittedModel]:
    """The steps up to the first whose effect explains nothing significant given those before.

    After an exchange, one of two effects may be sufficient alone.
    """
    limit = fits.rules.significance
    pairs = takewhile(lambda pair: p_value_of(fits, *pair) < limit, pairwise(steps))
    return [steps[0], *(large for _, large in pairs)]


def p_value_of(fits: FitCache, small: FittedModel, large: FittedModel) -> float:
    """p-value of the last effect of `large`, the larger of two tests, corrected for the library."""
    by_fit = fits.gain(small, large).p_value
    by_residual = step_p(fits, small, large)
    return min(1.0, max(by_fit, by_residual) * max(1, fits.tried - len(small.effects)))


def _converged(
    fits: FitCache, base: FittedModel, singles: Sequence[FittedModel]
) -> list[FittedModel]:
    """All singles, converged: their residuals are compared and reported."""
    pending = [added_effect(base, c) for c in singles if not c.fit.solution.converged]
    converged: dict[frozenset[str], FittedModel] = {}
    for first in range(0, len(pending), POLISHED):  # that many converge per call
        if fits.work.spent:
            break
        batch = fits.fit_extended(base, pending[first : first + POLISHED])
        converged |= {c.names: c for c in batch}
    return [converged.get(c.names, c) for c in singles]


def _with_noise(fits: FitCache, error: Noise) -> FitCache:
    """The fits of all trials jointly, with a model's own error as noise."""
    study, work = all_fitted(as_measured(fits.prepared)), fits.prepared.work
    prepared = PreparedStudy.of(study, misfit=error, solver=COARSE, work=work)
    prepared = replace(prepared, noise_model=fits.prepared.noise_model)
    setup = SearchSetup(prepared, fits.space, fits.library, fits.progress, fits.prior_q)
    return FitCache.of(replace(setup, rules=fits.rules))


def _own_error(fits: FitCache, models: Sequence[FittedModel]) -> Noise:
    """The smallest error so far on the fit trials, as noise of independent frames."""
    fitted = [replace(c, heldout=None) for c in models]
    best = min((residual_summary(fits.prepared, c) for c in fitted), key=lambda e: e.mean_square_m2)
    count = sum(fits.prepared.whiteners[t.name].count for t in fit_trials(fits.prepared))
    return Noise(best.rms_m * float(np.sqrt(max(1.0, count / best.independent))))


def largest_step(
    fits: FitCache, current: FittedModel, options: Sequence[FittedModel]
) -> FittedModel | None:
    """The model with the smallest residual, if it removes most of the error significantly.

    Models whose added effect is at a bound are excluded: the bound sets their size.
    """
    options = [c for c in options if not is_at_bound(current, c)]
    if not options:
        return None
    library = fits.tried - len(fits.added(current))
    adjusted = holm_among([step_p(fits, current, c) for c in options], library)
    mean_squares = [residual_summary(fits.prepared, c).mean_square_m2 for c in options]
    best = options[int(np.argmin(mean_squares))]
    p_value = max(adjusted[options.index(best)], fits.gain(current, best).p_value * library)
    most = fits.removed_share(current, best) > fits.rules.most_share
    return best if p_value < fits.rules.significance and most else None
