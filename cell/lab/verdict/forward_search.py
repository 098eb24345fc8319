"""Effects added one after another while each is significant and confirmed on held-out trials."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from cell.cable.effects.base import Effect
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel, Gain
from cell.lab.statistics.score import holm
from cell.lab.verdict.checks import explains
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.residual_summary import removed_share, residual_summary
from cell.lab.verdict.rivals import added_effect, close_rivals
from cell.lab.verdict.thresholds import Rules

_LOG = logging.getLogger(__name__)


def errors_in_words(candidate: FittedModel) -> str:
    """Fitted and held-out error, for the log."""
    held = candidate.heldout
    beyond = "none held out" if held is None else f"{held.rms_m * 1e3:.4f} mm held out"
    return f"{candidate.fit.rms_m * 1e3:.4f} mm fitted, {beyond}"


def searched(
    fits: FitCache, base: FittedModel, library: int, rules: Rules
) -> tuple[FittedModel, bool]:
    """The baseline with the effects that are believed; whether the search was cut short."""
    current = base
    for _ in range(rules.max_effects):
        if Evidence(fits, fits.baseline(), current, rules).below_stated:
            break
        if _hopeless_search(fits, current, rules, rules.hopeless_left):
            break
        spent = fits.prepared.work.simulated_s > rules.max_simulated_s
        if spent and current is not base:  # beside the baseline, all were refitted already
            return current, True
        options = fits.fit_extended(current, fits.shortlist(current, rules.max_refits))
        better = _accepted(fits, current, options, library, rules)
        if better is None:
            break
        if not _hopeless_search(fits, better, rules, rules.unexchanged_left):
            better = _exchanged(fits, better, rules)
        current = _pruned(fits, better, rules)
        _LOG.info("with %s: %s", ", ".join(sorted(current.names)), errors_in_words(current))
    return current, False


def _hopeless_search(fits: FitCache, current: FittedModel, rules: Rules, most_left: float) -> bool:
    """Whether no further effect, nor another for one found, can be hoped to leave noise.

    So it is if two have been found, and still more than a share `most_left` of the error is left.
    """
    if len(current.names) - len(fits.space.effects) < rules.first_effects:
        return False
    prepared = fits.prepared
    before, after = (
        residual_summary(prepared, fits.baseline()),
        residual_summary(prepared, current),
    )
    left = 1.0 - removed_share(prepared.noise_model.noise.std_m, before, after)
    return left > most_left


def added_to(fits: FitCache, candidate: FittedModel) -> list[type[Effect]]:
    """Effects of a candidate that the baseline did not have already."""
    return [e for e in candidate.effects if e not in fits.space.effects]


def _accepted(
    fits: FitCache,
    current: FittedModel,
    options: Sequence[FittedModel],
    library: int,
    rules: Rules,
) -> FittedModel | None:
    """The option with the most evidence, if it is significant and confirmed.

    Where there is none, one that the held-out trials are blind to.  Effects that were not refitted
    count as tried: their screen was no better than chance.
    """
    gains = [fits.gain(current, o) for o in options]
    tried = [g.p_value for g in gains]
    adjusted = holm(tried + [1.0] * (library - len(tried)))[: len(tried)]
    likely = [
        (o, g)
        for o, g, p in zip(options, gains, adjusted, strict=True)
        if p < rules.significance and g.delta_bic > 0.0
    ]
    sound = [o for o, g in likely if _confirmed(fits, current, o, g, rules)]
    if not sound:
        sound = [o for o, g in likely if _unseen(fits, current, o, g, rules)]
    return max(sound, key=lambda o: o.evidence) if sound else None


def _confirmed(
    fits: FitCache, small: FittedModel, large: FittedModel, gain: Gain, rules: Rules
) -> bool:
    """Whether the held-out trials bear out the last effect of `large`, by enough to matter."""
    base = fits.baseline().heldout
    if small.heldout is None or large.heldout is None or base is None:
        return True
    noise = fits.prepared.expected.std_m**2
    least = rules.first_share * noise
    if added_to(fits, small):
        excess = max(base.rms_m**2 - noise, 0.0)
        least = max(rules.more_share * noise, rules.excess_share * excess)
    fall = small.heldout.rms_m**2 - large.heldout.rms_m**2
    if not (gain.heldout > rules.heldout_gain and fall > least):
        return False
    return fits.heldout_log_lr(large, added_effect(small, large)) > rules.least_visible


def _unseen(
    fits: FitCache, small: FittedModel, large: FittedModel, gain: Gain, rules: Rules
) -> bool:
    """Whether the held-out trials are blind to an effect that the others show plainly."""
    if large.heldout is None or gain.heldout < -rules.heldout_gain:
        return False
    seen = fits.heldout_log_lr(large, added_effect(small, large))
    return seen < rules.least_visible and 2.0 * seen < rules.heldout_insensitive * gain.delta_chi2


def _exchanged(fits: FitCache, candidate: FittedModel, rules: Rules) -> FittedModel:
    """The candidate with effects exchanged one by one for others while evidence grows."""
    improved = len(added_to(fits, candidate)) > 1
    while improved and fits.prepared.work.simulated_s < rules.max_simulated_s:
        improved = False
        for effect in added_to(fits, candidate):
            rest = fits.fit_reduced(candidate, effect)
            options = fits.fit_extended(rest, fits.shortlist(rest, rules.max_refits))
            best = max(options, key=lambda c: c.evidence, default=candidate)
            if best.evidence > candidate.evidence + 1.0:
                candidate, improved = best, True
                break
    return candidate


def _pruned(fits: FitCache, candidate: FittedModel, rules: Rules) -> FittedModel:
    """The candidate without effects that the others have made unnecessary."""
    for effect in added_to(fits, candidate):
        rest = fits.fit_reduced(candidate, effect)
        gain = fits.gain(rest, candidate)
        kept = _confirmed(fits, rest, candidate, gain, rules) or _unseen(
            fits, rest, candidate, gain, rules
        )
        if gain.delta_bic <= 0.0 or not kept:
            return _pruned(fits, rest, rules)
    return candidate


def in_order(fits: FitCache, final: FittedModel) -> tuple[FittedModel, ...]:
    """From the baseline to `final`, the effect with the most evidence first."""
    steps = [final]
    while added := added_to(fits, steps[0]):
        smaller = [fits.fit_reduced(steps[0], e) for e in added]
        steps.insert(0, max(smaller, key=lambda c: c.evidence))
    return tuple(steps)


def _tied(
    fits: FitCache,
    final: FittedModel,
    effect: type[Effect],
    rules: Rules,
) -> tuple[str, ...]:
    """Effects that explain as much in place of `effect`, all trials together."""
    rest = fits.fit_reduced(final, effect)
    rivals = fits.fit_extended(rest, fits.shortlist(rest, rules.max_refits))
    close = close_rivals(fits, final, rivals, rules)
    names = [next(iter(c.names - rest.names)) for c in close]
    return tuple(name for name in names if name not in final.names)


def with_ties(
    fits: FitCache, base: FittedModel, found: FittedModel, rules: Rules
) -> tuple[FittedModel, dict[str, tuple[str, ...]]]:
    """What was found, and the ties of each effect, without one that too many others could be.

    Not the only one, and only if what was found explains the study without it too: what any of
    many effects does as well is none of them in particular.
    """
    added = added_to(fits, found)
    tied = {e.name: _tied(fits, found, e, rules) for e in added}
    for effect in added if len(added) > 1 else ():
        if len(tied[effect.name]) + 1 > rules.max_tied:
            rest = fits.fit_reduced(found, effect)
            if explains(Evidence(fits, base, rest, rules)):
                return with_ties(fits, base, rest, rules)
    return found, tied
