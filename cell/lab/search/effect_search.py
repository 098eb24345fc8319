"""The search for effects that a model lacks.

Forward: the effect with the most evidence is added while it is significant and confirmed on
held-out trials.  Then every effect added is exchanged for every other while that brings evidence,
and each is tested again with all others in.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cell.lab.data.thresholds import Rules
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache, noise_reestimated
from cell.lab.search.fitted_model import FittedModel, added_effect
from cell.lab.search.stepwise import exchanged, holm_among, in_order, levels, pruned

_LOG = logging.getLogger(__name__)


def errors_in_words(candidate: FittedModel) -> str:
    """Fitted and held-out error, for the log."""
    held = candidate.heldout
    beyond = "none held out" if held is None else f"{held.rms_m * 1e3:.4f} mm held out"
    return f"{candidate.fit.rms_m * 1e3:.4f} mm fitted, {beyond}"


@dataclass(frozen=True)
class Confirmation:
    """Held-out test of one more effect.

    gain         ln of how much likelier they become
    fall_m2      of their mean square; least_m2: from which it matters
    delta_chi2   that the effect explains of the trials fitted to
    log_lr       ln of how much likelier the effect itself makes them, all else as fitted
    """

    gain: float
    fall_m2: float
    least_m2: float
    delta_chi2: float
    log_lr: Callable[[], float]

    def is_given(self, rules: Rules) -> bool:
        """Whether they bear the effect out, by enough to matter."""
        matters = self.gain > rules.heldout_gain and self.fall_m2 > self.least_m2
        return matters and self.log_lr() > rules.heldout_gain

    def is_impossible(self, rules: Rules) -> bool:
        """Whether they cannot show an effect that the other trials show plainly."""
        if self.gain < -rules.heldout_gain:
            return False
        seen = self.log_lr()
        plain = 2.0 * seen < rules.small_share * self.delta_chi2
        return seen < rules.heldout_gain and plain


@dataclass(frozen=True, eq=False)
class ConfirmedEffects:
    """The criterion of a diagnosis: an effect is significant, and held-out trials confirm it.

    library  number of effects to choose from: those not refitted count as tried, because their
             screen was no better than chance
    """

    fits: FitCache

    def accepted(self, current: FittedModel, options: Sequence[FittedModel]) -> FittedModel | None:
        """The option with the most evidence of those confirmed; else of those that cannot be."""
        fits, rules = self.fits, self.fits.rules
        gains = [fits.gain(current, o) for o in options]
        adjusted = holm_among([g.p_value for g in gains], fits.tried)
        likely = [
            (o, self._confirmation(current, o))
            for o, g, p in zip(options, gains, adjusted, strict=True)
            if p < rules.significance and g.delta_bic > 0.0
        ]
        sound = [o for o, c in likely if c is None or c.is_given(rules)]
        if not sound:
            sound = [o for o, c in likely if c is not None and c.is_impossible(rules)]
        return max(sound, key=lambda o: o.evidence, default=None)

    def better(
        self, rest: FittedModel, options: Sequence[FittedModel], model: FittedModel
    ) -> FittedModel | None:
        """The option with the most evidence, if that is more than the model's."""
        best = max(options, key=lambda c: c.evidence, default=model)
        return best if best.evidence > model.evidence + 1.0 else None

    def needed(self, rest: FittedModel, model: FittedModel) -> bool:
        """Whether the model's effect that the rest lacks is confirmed given it."""
        found, rules = self._confirmation(rest, model), self.fits.rules
        kept = found is None or found.is_given(rules) or found.is_impossible(rules)
        return kept and self.fits.gain(rest, model).delta_bic > 0.0

    def _confirmation(self, small: FittedModel, large: FittedModel) -> Confirmation | None:
        """What held-out trials say of the last effect of `large`; None if there are none."""
        fits, rules = self.fits, self.fits.rules
        base = fits.base.heldout
        if small.heldout is None or large.heldout is None or base is None:
            return None
        noise_m2, gain = fits.prepared.expected_m("validate") ** 2, fits.gain(small, large)
        least_m2 = rules.negligible_share * noise_m2
        if fits.added(small):
            excess_m2 = max(base.rms_m**2 - noise_m2, 0.0)
            least_m2 = max(rules.slight_share * noise_m2, rules.negligible_share * excess_m2)
        return Confirmation(
            gain=gain.heldout,
            fall_m2=small.heldout.rms_m**2 - large.heldout.rms_m**2,
            least_m2=least_m2,
            delta_chi2=gain.delta_chi2,
            log_lr=lambda: fits.heldout_log_lr(large, added_effect(small, large)),
        )


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search: the final model, and the models fitted on the way.

    fits       models by their effects
    singles    the baseline with each effect that was worth a fit
    model      the baseline with the effects accepted
    all_tried  none of `singles` was left out because the budget was spent
    refined    the setup of a repeated search: given the model, the study shows another noise or
               mesh error, which would be taken for a misfit or for another effect; None = the same
    """

    fits: FitCache
    singles: tuple[FittedModel, ...]
    model: FittedModel
    all_tried: bool
    refined: SearchSetup | None


def search_effects(fits: FitCache) -> SearchResult:
    """Search the effects that the baseline lacks, within the budget of the present stage."""
    singles = fits.extended(fits.base)
    all_tried = not fits.work.left_out
    model, refined = _accepted(fits)
    return SearchResult(fits, tuple(singles), model, all_tried, refined)


def _accepted(fits: FitCache) -> tuple[FittedModel, SearchSetup | None]:
    """The baseline with the effects accepted; the setup of a repeated search if one is needed."""
    base, rules, criterion = fits.base, fits.rules, ConfirmedEffects(fits)

    def in_time() -> bool:
        return fits.work.affords("further effects")

    def kept(current: FittedModel, options: Sequence[FittedModel]) -> list[FittedModel]:
        better = criterion.accepted(current, options)
        if better is None:
            return []
        if len(fits.added(better)) > 1 and not _two_leave_most(fits, better):
            better = exchanged(fits, better, criterion.better, in_time)
        better = pruned(fits, better, criterion.needed)
        _LOG.info("with %s: %s", ", ".join(sorted(better.names)), errors_in_words(better))
        return [better]

    for step, (current,) in enumerate(levels(base, fits.extended, kept)):
        explained = current is not base and fits.explained_by(current)
        if explained and (refined := noise_reestimated(fits, current)) is not None:
            return current, refined
        if step == rules.most_named or fits.is_below_stated(current):
            break
        if _two_leave_most(fits, current):
            break
        if current is not base and not in_time():  # the baseline's were all refitted already
            return current, None
    unexplained = current is not base and not fits.explained_by(current)
    return current, noise_reestimated(fits, current) if unexplained else None


def _two_leave_most(fits: FitCache, current: FittedModel) -> bool:
    """Whether two effects leave most of the error: one more, or exchanged, will not explain it."""
    if len(fits.added(current)) < 2:
        return False
    return 1.0 - fits.removed_share(fits.base, current) > fits.rules.most_share


def path_to(fits: FitCache, final: FittedModel) -> tuple[FittedModel, ...]:
    """Models from the baseline to `final`, the effect with the most evidence first."""
    return tuple(in_order(fits, final, lambda c: c.evidence))
