"""Check whether effects estimated with an earlier cable's prior are needed without that prior."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.special import chdtrc as chi2_sf

from cell.cable.effects.base import Effect
from cell.identify.parameters import ParameterSpace, Prior
from cell.lab.data.prepared import PreparedStudy, as_measured
from cell.lab.fit.fitting import space_with
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel, error_over_noise
from cell.lab.search.rivals import close_rivals
from cell.lab.search.stepwise import levels
from cell.lab.verdict.evidence import Evidence

Explains = Callable[[Evidence], bool]


def prior_driven_effects(evidence: Evidence, explains: Explains) -> tuple[str, ...]:
    """Effects that are not needed, or explain nothing, without the prior.

    The study is asked without the prior: the fewest of them that explain it to its noise are
    needed, each unless another, not `tied` with it, explains as much or more in its place.
    Where, with all of them in, parameters that agree with the prior explain the study to the
    measurement's noise, they account for all that sets this cable apart; then one that the prior
    alone asks for is what a prior is for.  Several are never spared: that the cable is not the
    prior's is the simpler explanation.
    """
    fits = evidence.fits
    if fits.prior_q is None or evidence.is_base:
        return ()
    spared = int(_of_this_cable(fits, evidence.final))
    if len(evidence.added) <= spared:
        return ()
    alone = _without_prior(fits)
    found = unconfirmed_without_prior(alone, evidence.added, evidence.tied, explains)
    return found if len(found) > spared else ()


def _without_prior(fits: FitCache) -> FitCache:
    """The same study, as of a cable of which nothing is known."""
    prepared, space = fits.prepared, fits.space
    free = ParameterSpace.of(
        space.cable,
        gravity_m_per_s2=space.gravity_m_per_s2,
        prior=Prior(knots=space.knots),
        pull_m_per_s2=space.pull_m_per_s2,
    )
    return FitCache.of(
        SearchSetup(
            PreparedStudy.of(as_measured(prepared), solver=prepared.solver, work=prepared.work),
            space_with(free, space.effects),
            fits.library,
            fits.progress,
            rules=fits.rules,
        )
    )


def unconfirmed_without_prior(
    alone: FitCache,
    effects: Sequence[type[Effect]],
    tied: Mapping[str, Sequence[str]],
    explains: Explains,
) -> tuple[str, ...]:
    """The effects that are not needed, or explain nothing, in a study without a prior."""
    base = alone.base

    def extended(model: FittedModel) -> Sequence[FittedModel]:
        others = [e for e in effects if e.name not in model.names]
        return alone.fit_extended(model, others) if others else ()

    for level in levels(base, extended, lambda _, options: options):
        fewest = [c for c in level if explains(Evidence(alone, c))]
        if fewest:
            needed = max(fewest, key=lambda c: c.evidence)
            return tuple(
                e.name
                for e in effects
                if e.name not in needed.names
                or _in_place(alone, needed, e) - set(tied.get(e.name, ()))
            )
    return tuple(e.name for e in effects)


def _in_place(alone: FitCache, needed: FittedModel, effect: type[Effect]) -> frozenset[str]:
    """Effects that explain as much as one of a candidate's, or more, in its place."""
    rest = alone.fit_reduced(needed, effect)
    rivals = alone.extended(rest)
    found = [c.names - rest.names for c in close_rivals(alone, needed, rivals)]
    return frozenset().union(*found) - needed.names


def _of_this_cable(fits: FitCache, final: FittedModel) -> bool:
    """Whether a model explains the study to the measurement's noise, and agrees with the prior."""
    if error_over_noise(fits.prepared, final) > fits.rules.most_over_noise:
        return False
    space = fits.space
    own = [final.fit.space.names.index(n) for n in space.names]
    away = final.fit.q[own] - space.mean
    square = float(away @ space.precision @ away)
    chance = float(chi2_sf(len(away), square))
    return bool(np.isfinite(square) and chance > fits.rules.residual_significance)
