"""Models that explain as much as another, and the chance of what one more effect removes."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.special import chdtrc as chi2_sf

from cell.cable.effects.base import Effect
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.verdict.evidence import above_noise
from cell.lab.verdict.residual_summary import ResidualSummary, log_variance_ratio, residual_summary
from cell.lab.verdict.rules import Rules


def close_rivals(
    fits: FitCache, final: FittedModel, rivals: Sequence[FittedModel], rules: Rules
) -> list[FittedModel]:
    """Rivals that explain as much as `final`, all trials together, the best first.

    By χ² where what remains is noise; where the model's own error remains, by that, with its
    colour: it is what the answer could be wrong by.
    """
    close = {c.names for c in rivals if c.chi2 < final.chi2 + rules.tie_delta_chi2}
    if above_noise(fits, final) > rules.misfit:
        mine = residual_summary(fits.prepared, final)
        close |= {
            c.names
            for c in rivals
            if log_variance_ratio(mine, residual_summary(fits.prepared, c)) < rules.tie_delta_chi2
        }
    return sorted((c for c in rivals if c.names in close), key=lambda c: c.chi2)


def chance_of(fits: FitCache, small: FittedModel, large: FittedModel) -> float:
    """p-value of what one more effect removes, against what it leaves, over all trials."""
    prepared = fits.prepared
    return chance(
        small, large, residual_summary(prepared, small), residual_summary(prepared, large)
    )


def chance(
    small: FittedModel, large: FittedModel, before: ResidualSummary, after: ResidualSummary
) -> float:
    """p-value of the fall from what `small` leaves to what `large`, with one effect more, does."""
    effect = added_effect(small, large)
    fall = max(log_variance_ratio(after, before), 0.0)
    return float(chi2_sf(sum(p.amplitude for p in effect.parameters), max(fall, 0.0)))


def added_effect(small: FittedModel, large: FittedModel) -> type[Effect]:
    """The effect of `large` that `small` lacks."""
    return next(e for e in large.effects if e.name not in small.names)
