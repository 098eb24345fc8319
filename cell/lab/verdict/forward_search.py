"""Effects added one after another while each is significant and confirmed on held-out trials."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cell.cable.effects.base import Effect
from cell.lab.data.thresholds import Rules
from cell.lab.search.fit_cache import FitCache, settled_beside
from cell.lab.search.fitted_model import FittedModel
from cell.lab.search.stepwise import exchanged, holm_among, in_order, levels, pruned
from cell.lab.search.study_space import StudySpace
from cell.lab.verdict.checks import explains
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.residual_summary import removed_share, residual_summary
from cell.lab.verdict.rivals import added_effect, close_rivals

_LOG = logging.getLogger(__name__)


def errors_in_words(candidate: FittedModel) -> str:
    """Fitted and held-out error, for the log."""
    held = candidate.heldout
    beyond = "none held out" if held is None else f"{held.rms_m * 1e3:.4f} mm held out"
    return f"{candidate.fit.rms_m * 1e3:.4f} mm fitted, {beyond}"


@dataclass(frozen=True)
class Confirmation:
    """What the held-out trials say of one more effect.

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
    library: int
    rules: Rules

    def accepted(self, current: FittedModel, options: Sequence[FittedModel]) -> FittedModel | None:
        """The option with the most evidence of those confirmed; else of those that cannot be."""
        rules = self.rules
        gains = [self.fits.gain(current, o) for o in options]
        adjusted = holm_among([g.p_value for g in gains], self.library)
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
        """Whether the model's effect that the rest lacks is confirmed beside it."""
        found, rules = self._confirmation(rest, model), self.rules
        kept = found is None or found.is_given(rules) or found.is_impossible(rules)
        return kept and self.fits.gain(rest, model).delta_bic > 0.0

    def _confirmation(self, small: FittedModel, large: FittedModel) -> Confirmation | None:
        """What held-out trials say of the last effect of `large`; None if there are none."""
        fits, rules = self.fits, self.rules
        base = fits.baseline().heldout
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
class Searched:
    """Where a search ended.

    model      the baseline with the effects that are believed
    cut_short  its limit of work has ended it
    again      the study as it shows beside that model, to be searched anew: what the mesh errs by
               would be taken for another effect, and noise that is wrong for a misfit
    """

    model: FittedModel
    cut_short: bool = False
    again: FitCache | None = None


def searched(fits: FitCache, base: FittedModel, library: int, rules: Rules) -> Searched:
    """The search for effects that are believed, until it ends or must begin anew."""
    space, criterion = StudySpace(fits, rules.max_refits), ConfirmedEffects(fits, library, rules)

    def in_time() -> bool:
        return fits.work.affords("further effects")

    def kept(current: FittedModel, options: Sequence[FittedModel]) -> list[FittedModel]:
        better = criterion.accepted(current, options)
        if better is None:
            return []
        if len(fits.added(better)) > 1 and not _two_leave_most(fits, better, rules):
            better = exchanged(space, better, criterion.better, in_time)
        better = pruned(space, better, criterion.needed)
        _LOG.info("with %s: %s", ", ".join(sorted(better.names)), errors_in_words(better))
        return [better]

    for step, (current,) in enumerate(levels(base, space.extended, kept)):
        explained = current is not base and fits.explained_by(current)
        if explained and (again := settled_beside(fits, current)) is not None:
            return Searched(current, again=again)
        if step == rules.most_named or Evidence(fits, base, current, rules).below_stated:
            break
        if _two_leave_most(fits, current, rules):
            break
        if current is not base and not in_time():  # beside the baseline all were refitted already
            return Searched(current, cut_short=True)
    unasked = current is not base and not fits.explained_by(current)
    return Searched(current, again=settled_beside(fits, current) if unasked else None)


def _two_leave_most(fits: FitCache, current: FittedModel, rules: Rules) -> bool:
    """Whether two effects leave most of the error: one more, or exchanged, will not explain it."""
    if len(fits.added(current)) < 2:
        return False
    prepared = fits.prepared
    before, after = (
        residual_summary(prepared, fits.baseline()),
        residual_summary(prepared, current),
    )
    return 1.0 - removed_share(prepared.noise_model.noise.std_m, before, after) > rules.most_share


def steps_to(fits: FitCache, final: FittedModel, rules: Rules) -> tuple[FittedModel, ...]:
    """From the baseline to `final`, the effect with the most evidence first."""
    return tuple(in_order(StudySpace(fits, rules.max_refits), final, lambda c: c.evidence))


def _tied(
    fits: FitCache,
    final: FittedModel,
    effect: type[Effect],
    rules: Rules,
) -> tuple[str, ...]:
    """Effects that explain as much in place of `effect`, all trials together."""
    rest = fits.fit_reduced(final, effect)
    rivals = StudySpace(fits, rules.max_refits).extended(rest)
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
    added = fits.added(found)
    tied = {e.name: _tied(fits, found, e, rules) for e in added}
    for effect in added if len(added) > 1 else ():
        if len(tied[effect.name]) + 1 > rules.most_named:
            rest = fits.fit_reduced(found, effect)
            if explains(Evidence(fits, base, rest, rules)):
                return with_ties(fits, base, rest, rules)
    return found, tied
