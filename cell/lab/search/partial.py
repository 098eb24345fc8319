"""Partial explanations: effects that explain most of an error, but leave more than noise.

Where no set of effects fits to the noise, the model's own error limits every conclusion.  So it
takes the place of the noise here, with its correlation.  The model is fitted to all trials jointly:
effects are compared by how much they change the fit, not by their forecasts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from cell.cable.solver import Solver
from cell.identify.noise import Noise
from cell.lab.data.prepared import PreparedStudy, all_fitted, as_measured
from cell.lab.fit.fitting import fit_trials, taken_from
from cell.lab.fit.plausibility import is_hopeless
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.extension import POLISHED
from cell.lab.search.fit_cache import FitCache, with_lower_baseline
from cell.lab.search.fitted_model import FittedModel, added_effect
from cell.lab.search.residual_summary import (
    residual_summary,
)
from cell.lab.search.rivals import chance_of, is_at_bound, near_singles
from cell.lab.search.stepwise import exchanged, holm_among, in_order, levels

#: Its error is far below what a model errs by that explains a study in part; it saves time.
COARSE = Solver(segments=20, step_s=1.5e-3)

#: The fits are repeated with the least error found as noise, if that is below this share of the
#: error before; so often at most.
REWEIGHTED_BELOW = 0.5
MOST_REWEIGHTINGS = 3


@dataclass(frozen=True, eq=False)
class PartialExplanation:
    """Fits to all trials jointly, whitened by the model's own error.

    fits  with all trials to be fitted
    singles   each effect worth it alone given the baseline
    path      the baseline, then with each effect that removes most of what is left
    """

    fits: FitCache
    singles: tuple[FittedModel, ...]
    path: tuple[FittedModel, ...]


def explain_partly(fits: FitCache) -> PartialExplanation:
    """Explain most of a study that nothing explains to its noise.

    What the best model so far leaves is the model's own error.
    """
    error, lowest = _own_error(fits, fits.known()), fits.base
    least_m = residual_summary(fits.prepared, lowest).rms_m
    for _ in range(MOST_REWEIGHTINGS):
        joint = _with_noise(fits, error)
        if least_m < residual_summary(joint.prepared, joint.base).rms_m:
            # fitted to all trials a model leaves no more of them
            joint = with_lower_baseline(joint, lowest.fit.q, fits.rules.tie_delta_chi2)
        joint, singles = _singles(joint)
        base = joint.base
        lowest, least_m = base, min(least_m, residual_summary(joint.prepared, base).rms_m)
        before, error = error, _own_error(joint, joint.known())
        # Fits that were stuck have an error that is no model's own; trials that weigh little are
        # fitted from anywhere.
        if error.std_m > REWEIGHTED_BELOW * before.std_m or joint.work.spent:
            break
    steps = _added(joint, base, singles)
    steps = _significant_steps(joint, steps)
    if len(steps) == 2:
        for rival in near_singles(joint, steps[1], singles):
            joint.extended(rival)
    unfinished = not joint.work.affords("the search for effects that explain most")
    # nor does any model explain a cable that is hopeless
    if unfinished or is_hopeless(joint.prepared, steps[-1].fit):
        steps = [base]
    return PartialExplanation(joint, tuple(singles), tuple(steps))


def _added(joint: FitCache, base: FittedModel, singles: Sequence[FittedModel]) -> list[FittedModel]:
    """The baseline, and one effect after another that removes most of what is left; exchanged."""
    steps: list[FittedModel] = []

    def extended(model: FittedModel) -> Sequence[FittedModel]:
        return singles if model is base else joint.extended(model)

    def kept(model: FittedModel, options: Sequence[FittedModel]) -> list[FittedModel]:
        found = largest_step(joint, model, options)
        return [] if found is None else [found]

    for (model,) in levels(base, extended, kept):
        steps.append(model)
        if len(steps) == joint.rules.most_named:
            break
    if len(steps) < 3:
        return steps
    prepared = joint.prepared

    def left(model: FittedModel) -> float:
        return residual_summary(prepared, model).mean_square_m2

    def better(
        rest: FittedModel, options: Sequence[FittedModel], model: FittedModel
    ) -> FittedModel | None:
        sound = [c for c in options if not is_at_bound(rest, c)]
        best = min(sound, key=left, default=None)
        return best if best is not None and left(best) < left(model) else None

    def in_time() -> bool:
        return prepared.work.affords("the exchange of effects that explain most")

    final = exchanged(joint, steps[-1], better, in_time)
    return in_order(joint, final, lambda c: -left(c))


def _singles(joint: FitCache) -> tuple[FitCache, list[FittedModel]]:
    """Each effect worth it alone given the baseline, converged; and the fits of that baseline.

    One explains only what the same model without it does not, wherever its search began: the
    baseline is fitted from where the best one ended too.
    """
    singles: list[FittedModel] = []
    for _ in range(MOST_REWEIGHTINGS):
        base = joint.base
        singles = _finished(joint, base, joint.extended(base))
        best = largest_step(joint, base, singles)
        if best is None:
            break
        if joint.work.spent:
            break
        lower = with_lower_baseline(
            joint, taken_from(best.fit, base.fit.space), joint.rules.tie_delta_chi2
        )
        if lower is joint:
            break
        joint = lower
    return joint, singles


def _significant_steps(fits: FitCache, steps: Sequence[FittedModel]) -> list[FittedModel]:
    """The steps up to the first whose effect explains nothing significant given those before.

    Of two effects found together, exchanged and put in order, one may need no other.
    """
    kept = list(steps[:1])
    for small, large in pairwise(steps):
        if p_value_of(fits, small, large) >= fits.rules.significance:
            break
        kept.append(large)
    return kept


def p_value_of(fits: FitCache, small: FittedModel, large: FittedModel) -> float:
    """p-value of the last effect of `large`, the larger of two tests, corrected for the library."""
    by_fit = fits.gain(small, large).p_value
    by_residual = chance_of(fits, small, large)
    return min(1.0, max(by_fit, by_residual) * max(1, fits.tried - len(small.effects)))


def _finished(
    fits: FitCache, base: FittedModel, singles: Sequence[FittedModel]
) -> list[FittedModel]:
    """All singles taken to convergence: how much each leaves is compared and told."""
    pending = [added_effect(base, c) for c in singles if not c.fit.solution.converged]
    finished: dict[frozenset[str], FittedModel] = {}
    for first in range(0, len(pending), POLISHED):  # it takes only so many to convergence at once
        if fits.work.spent:
            break
        few = fits.fit_extended(base, pending[first : first + POLISHED])
        finished |= {c.names: c for c in few}
    return [finished.get(c.names, c) for c in singles]


def _with_noise(fits: FitCache, error: Noise) -> FitCache:
    """The fits of all trials together, with a model's own error for noise."""
    prepared = PreparedStudy.of(
        all_fitted(as_measured(fits.prepared)),
        misfit=error,
        solver=COARSE,
        work=fits.prepared.work,
    )
    prepared = replace(prepared, noise_model=fits.prepared.noise_model)
    setup = SearchSetup(prepared, fits.space, fits.library, fits.progress, fits.prior_q)
    return FitCache.of(replace(setup, rules=fits.rules))


def _own_error(fits: FitCache, tried: Sequence[FittedModel]) -> Noise:
    """The least error so far on the fit trials, as noise of independent frames."""
    fitted = [replace(c, heldout=None) for c in tried]
    left = min((residual_summary(fits.prepared, c) for c in fitted), key=lambda e: e.mean_square_m2)
    count = sum(fits.prepared.whiteners[t.name].count for t in fit_trials(fits.prepared))
    return Noise(left.rms_m * float(np.sqrt(max(1.0, count / left.independent))))


def largest_step(
    fits: FitCache, current: FittedModel, options: Sequence[FittedModel]
) -> FittedModel | None:
    """The model with the smallest residual, if it removes most of the error significantly.

    Models whose added effect is at a bound are excluded: the bound decided, not the measurement.
    """
    options = [c for c in options if not is_at_bound(current, c)]
    if not options:
        return None
    library = fits.tried - len(fits.added(current))
    adjusted = holm_among([chance_of(fits, current, c) for c in options], library)
    left = [residual_summary(fits.prepared, c).mean_square_m2 for c in options]
    best = options[int(np.argmin(left))]
    p_value = max(adjusted[options.index(best)], fits.gain(current, best).p_value * library)
    most = fits.removed_share(current, best) > fits.rules.most_share
    return best if p_value < fits.rules.significance and most else None
