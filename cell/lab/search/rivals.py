"""Models that fit as well as another, and the p-value of one more effect."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.special import chdtrc as chi2_sf

from cell.lab.fit.plausibility import at_bound
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import (
    FittedModel,
    added_effect,
    error_over_noise,
    log_variance_ratio,
    residual_summary,
)


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
