"""The search for effects that a model lacks.

Forward: the effect with the most evidence is added while it is significant and confirmed on
held-out trials.  Then every added effect is exchanged for every other while that increases the
evidence, and each is tested again given all others.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from cell.lab.data.rules import Rules
from cell.lab.search.baseline import SearchSetup
from cell.lab.search.fit_cache import FitCache, noise_reestimated
from cell.lab.search.fitted_model import FittedModel, added_effect
from cell.lab.search.stepwise import exchanged, holm_among, levels, pruned

_LOG = logging.getLogger(__name__)


def errors_in_words(candidate: FittedModel) -> str:
    """Fitted and held-out error, for the log."""
    heldout = candidate.heldout
    held_out = "none held out" if heldout is None else f"{heldout.rms_m * 1e3:.4f} mm held out"
    return f"{candidate.fit.rms_m * 1e3:.4f} mm fitted, {held_out}"


@dataclass(frozen=True)
class Confirmation:
    """Held-out test of one more effect.

    gain         ln likelihood ratio of the held-out trials
    fall_m2      of their mean square error, m²; least_m2: smallest relevant one
    delta_chi2   that the effect explains of the trials fitted to
    log_lr       their ln likelihood ratio by the effect alone, the other parameters not refitted
    """

    gain: float
    fall_m2: float
    least_m2: float
    delta_chi2: float
    log_lr: Callable[[], float]

    def is_confirmed(self, rules: Rules) -> bool:
        """Whether the held-out trials confirm the effect, with a relevant size."""
        matters = self.gain > rules.heldout_gain and self.fall_m2 > self.least_m2
        return matters and self.log_lr() > rules.heldout_gain

    def is_impossible(self, rules: Rules) -> bool:
        """Whether the held-out trials cannot show an effect that the fitted trials show clearly."""
        if self.gain < -rules.heldout_gain:
            return False
        log_lr = self.log_lr()
        weak = 2.0 * log_lr < rules.small_share * self.delta_chi2
        return log_lr < rules.heldout_gain and weak


def _effect_to_add(
    fits: FitCache, current: FittedModel, options: Sequence[FittedModel]
) -> FittedModel | None:
    """The confirmed option with the most evidence; else the best that cannot be confirmed.

    An effect is added if its p, corrected by Holm, is below `Rules.significance`, its ΔBIC is
    positive, and the held-out trials confirm it.  All effects of the library count as tried: those
    not refitted were not significant in the screen.
    """
    rules, gains = fits.rules, [fits.gain(current, o) for o in options]
    adjusted = holm_among([g.p_value for g in gains], fits.tried)
    likely = [
        (o, _confirmation(fits, current, o))
        for o, g, p in zip(options, gains, adjusted, strict=True)
        if p < rules.significance and g.delta_bic > 0.0
    ]
    sound = [o for o, c in likely if c is None or c.is_confirmed(rules)]
    if not sound:
        sound = [o for o, c in likely if c is not None and c.is_impossible(rules)]
    return max(sound, key=lambda o: o.evidence, default=None)


def _better(
    rest: FittedModel, options: Sequence[FittedModel], model: FittedModel
) -> FittedModel | None:
    """The option with the most evidence, if that is more than the model's."""
    best = max(options, key=lambda c: c.evidence, default=model)
    return best if best.evidence > model.evidence + 1.0 else None


def _is_needed(fits: FitCache, rest: FittedModel, model: FittedModel) -> bool:
    """Whether the effect that `rest` lacks is confirmed given the effects of `rest`."""
    test, rules = _confirmation(fits, rest, model), fits.rules
    passed = test is None or test.is_confirmed(rules) or test.is_impossible(rules)
    return passed and fits.gain(rest, model).delta_bic > 0.0


def _confirmation(fits: FitCache, small: FittedModel, large: FittedModel) -> Confirmation | None:
    """Held-out test of the last effect of `large`; None if there are no held-out trials."""
    rules, base = fits.rules, fits.base.heldout
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
    refined    setup of a repeated search, if noise or mesh error given the model differ, which
               would be mistaken for a misfit or another effect; None = no repetition is needed
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
    base, rules = fits.base, fits.rules

    def in_time() -> bool:
        return fits.work.affords("further effects")

    def select(current: FittedModel, options: Sequence[FittedModel]) -> list[FittedModel]:
        better = _effect_to_add(fits, current, options)
        if better is None:
            return []
        if len(fits.added(better)) > 1 and not _two_explain_little(fits, better):
            better = exchanged(fits, better, _better, in_time)
        better = pruned(fits, better, partial(_is_needed, fits))
        _LOG.info("with %s: %s", ", ".join(sorted(better.names)), errors_in_words(better))
        return [better]

    for step, (current,) in enumerate(levels(base, fits.extended, select)):
        explained = current is not base and fits.explained_by(current)
        if explained and (refined := noise_reestimated(fits, current)) is not None:
            return current, refined
        if step == rules.most_named or fits.is_below_stated(current):
            break
        if _two_explain_little(fits, current):
            break
        if current is not base and not in_time():  # the baseline's effects are all refitted already
            return current, None
    unexplained = current is not base and not fits.explained_by(current)
    return current, noise_reestimated(fits, current) if unexplained else None


def _two_explain_little(fits: FitCache, current: FittedModel) -> bool:
    """Whether most of the error remains with two effects: a third will not explain it."""
    if len(fits.added(current)) < 2:
        return False
    return 1.0 - fits.removed_share(fits.base, current) > fits.rules.most_share
