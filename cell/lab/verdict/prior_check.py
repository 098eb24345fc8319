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
from cell.lab.search.partial import close_rivals
from cell.lab.search.stepwise import levels
from cell.lab.verdict.evidence import Evidence

Explains = Callable[[Evidence], bool]


def prior_driven_effects(evidence: Evidence, explains: Explains) -> tuple[str, ...]:
    """Effects that are not needed, or explain nothing, without the prior.

    The study is diagnosed without the prior.  Needed are the fewest effects that explain it to its
    noise, each unless an effect that is not `tied` with it explains as much or more in its place.
    One prior-driven effect is accepted if the model with all effects explains the study to the
    measurement's noise with parameters that agree with the prior.  Several are never accepted: a
    cable that differs from the prior's is the simpler explanation.
    """
    fits = evidence.fits
    accepted = int(_agrees_with_prior(fits, evidence.final))
    if len(evidence.added) <= accepted:
        return ()
    without_prior = _without_prior(fits)
    unconfirmed = unconfirmed_without_prior(without_prior, evidence.added, evidence.tied, explains)
    return unconfirmed if len(unconfirmed) > accepted else ()


def _without_prior(fits: FitCache) -> FitCache:
    """The fits of the same study with the uninformative prior of an unknown cable."""
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
    fits: FitCache,
    effects: Sequence[type[Effect]],
    tied: Mapping[str, Sequence[str]],
    explains: Explains,
) -> tuple[str, ...]:
    """The effects that are not needed, or explain nothing, in a study without a prior."""
    base = fits.base

    def extended(model: FittedModel) -> Sequence[FittedModel]:
        remaining = [e for e in effects if e.name not in model.names]
        return fits.fit_extended(model, remaining) if remaining else ()

    for level in levels(base, extended, lambda _, options: options):
        fewest = [c for c in level if explains(Evidence(fits, c))]
        if fewest:
            needed = max(fewest, key=lambda c: c.evidence)
            return tuple(
                e.name
                for e in effects
                if e.name not in needed.names
                or _in_place(fits, needed, e) - set(tied.get(e.name, ()))
            )
    return tuple(e.name for e in effects)


def _in_place(fits: FitCache, needed: FittedModel, effect: type[Effect]) -> frozenset[str]:
    """Effects that explain as much as `effect` of the model `needed`, or more, in its place."""
    reduced = fits.fit_reduced(needed, effect)
    rivals = fits.extended(reduced)
    replacements = [c.names - reduced.names for c in close_rivals(fits, needed, rivals)]
    return frozenset().union(*replacements) - needed.names


def _agrees_with_prior(fits: FitCache, final: FittedModel) -> bool:
    """Whether a model explains the study to the measurement's noise, and agrees with the prior."""
    if error_over_noise(fits.prepared, final) > fits.rules.most_over_noise:
        return False
    space = fits.space
    own = [final.fit.space.names.index(n) for n in space.names]
    offset = final.fit.q[own] - space.mean
    square = float(offset @ space.precision @ offset)
    p_value = float(chi2_sf(len(offset), square))
    return bool(np.isfinite(square) and p_value > fits.rules.residual_significance)
