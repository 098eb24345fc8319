"""Models that explain as much as another, and the chance of what one more effect removes."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.special import chdtrc as chi2_sf

from cell.cable.effects.base import Effect
from cell.lab.search.explore import Candidate, Explorer
from cell.lab.verdict.evidence import above_noise
from cell.lab.verdict.leftover import Leftover, deviance, leftover
from cell.lab.verdict.rules import Rules


def close_rivals(
    explorer: Explorer, final: Candidate, rivals: Sequence[Candidate], rules: Rules
) -> list[Candidate]:
    """Rivals that explain as much as `final`, all trials together, the best first.

    By χ² where what remains is noise; where the model's own error remains, by that, with its
    colour: it is what the answer could be wrong by.
    """
    close = {c.names for c in rivals if c.chi2 < final.chi2 + rules.tie}
    if above_noise(explorer, final) > rules.misfit:
        mine = leftover(explorer.prepared, final)
        close |= {
            c.names for c in rivals if deviance(mine, leftover(explorer.prepared, c)) < rules.tie
        }
    return sorted((c for c in rivals if c.names in close), key=lambda c: c.chi2)


def chance_of(explorer: Explorer, small: Candidate, large: Candidate) -> float:
    """p-value of what one more effect removes, against what it leaves, over all trials."""
    prepared = explorer.prepared
    return chance(small, large, leftover(prepared, small), leftover(prepared, large))


def chance(small: Candidate, large: Candidate, before: Leftover, after: Leftover) -> float:
    """p-value of the fall from what `small` leaves to what `large`, with one effect more, does."""
    effect = added_effect(small, large)
    fall = max(deviance(after, before), 0.0)
    return float(chi2_sf(sum(p.amplitude for p in effect.parameters), max(fall, 0.0)))


def added_effect(small: Candidate, large: Candidate) -> type[Effect]:
    """The effect of `large` that `small` lacks."""
    return next(e for e in large.effects if e.name not in small.names)
