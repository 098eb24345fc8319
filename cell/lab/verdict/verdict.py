"""Verdict of a diagnosis: whether what a model leaves is noise, and what explains as much."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from cell.cable.effects.base import Effect
from cell.lab.data.results import Verdict
from cell.lab.fit.fitting import Fit, fit_trials
from cell.lab.search.explore import Candidate, Explorer
from cell.lab.statistics.score import holm
from cell.lab.verdict.asked import of_a_wider_law, of_effects, of_what_trials_ask_for
from cell.lab.verdict.leftover import Leftover, deviance, leftover, removed_share
from cell.lab.verdict.rules import Rules
from cell.lab.verdict.smooth_part import (
    SmoothPart,
    of_a_finer_model,
    of_all_trials_together,
    smooth_part,
)
from cell.lab.verdict.stated import within_stated


def verdict_of(
    base: Candidate,
    final: Candidate,
    tied: dict[str, tuple[str, ...]],
    doubted: Sequence[str],
    rules: Rules,
) -> Verdict:
    """What it means that `final` explains the study; `doubted`: effects that are not confirmed."""
    if final is base:
        return "cannot_tell" if doubted else "complete"
    if final.heldout is None or doubted or any(len(t) + 1 > rules.most_tied for t in tied.values()):
        return "cannot_tell"
    return "missing"


def explains(explorer: Explorer, base: Candidate, final: Candidate, rules: Rules) -> bool:
    """Whether what a candidate leaves is noise, or of an earlier individual's error.

    With an earlier individual's model what is left may be that model's own error.  Then nothing is
    complete, and an effect must explain most of what the earlier model misses here.
    """
    if not _leaves_noise(explorer, base, final, rules):
        return False
    if _at_measurement_noise(explorer, final, rules):
        return True
    prepared = explorer.prepared
    before = leftover(prepared, explorer.prior_candidate())
    share = removed_share(prepared.floor.noise.std_m, before, leftover(prepared, final))
    return final is not base and share > rules.most_share


def unconfirmed(explorer: Explorer, final: Candidate, rules: Rules) -> tuple[str, ...]:
    """Effects found that the held-out trials, if there are any, cannot see."""
    if final.heldout is None:
        return ()
    found = [e for e in final.effects if e not in explorer.space.effects]
    return tuple(e.name for e in found if explorer.visible(final, e) < rules.least_visible)


def hopeless_search(explorer: Explorer, current: Candidate, rules: Rules, most_left: float) -> bool:
    """Whether no further effect, nor another for one found, can be hoped to leave noise.

    So it is if two have been found, and still more than a share `most_left` of the error is left.
    """
    if len(current.names) - len(explorer.space.effects) < rules.first_effects:
        return False
    prepared = explorer.prepared
    before, after = leftover(prepared, explorer.baseline()), leftover(prepared, current)
    left = 1.0 - removed_share(prepared.floor.noise.std_m, before, after)
    return left > most_left


def _at_measurement_noise(explorer: Explorer, candidate: Candidate, rules: Rules) -> bool:
    """Whether a candidate errs by no more than the measurement, fitted or held out.

    Where the noise is the measurement's own, the tests of the residual have said so already.
    """
    prepared = explorer.prepared
    if prepared.noise_is_measured:
        return True
    return above_noise(explorer, candidate) < rules.gross_misfit


def above_noise(explorer: Explorer, candidate: Candidate) -> float:
    """Larger of a candidate's fitted and held-out error over the measurement's noise."""
    held_m = candidate.heldout.rms_m if candidate.heldout else 0.0
    return max(candidate.fit.rms_m, held_m) / explorer.prepared.floor.noise.std_m


def suspected(
    explorer: Explorer, base: Candidate, final: Candidate, rivals: Collection[str], rules: Rules
) -> tuple[str, ...]:
    """Effects that all trials together ask for beside a model that leaves noise.

    Those held out alone do not bear them out, or they would have been accepted; but who has all
    that is there asks for nothing more, but for what the model itself is wrong by.

    rivals   effects tied with those of `final`: what these leave of each other is no question
    returns  the plainest first
    """
    offered = [e for n, e in explorer.library.items() if n not in {*final.names, *rivals}]
    asked = of_effects(explorer.prepared, final.fit, offered)
    adjusted = holm([p for _, p in asked.values()])
    fall = base.chi2 - final.chi2
    plain = [
        (p, name)
        for (name, (part, _)), p in zip(asked.items(), adjusted, strict=True)
        if p < rules.misfit_significance and part.chi2 - part.count > rules.law_share * fall
    ]
    return tuple(name for _, name in sorted(plain))


def broken_laws(explorer: Explorer, base: Candidate, final: Candidate, rules: Rules) -> list[str]:
    """Effects found beside which a wider law of theirs explains more: something else is there."""
    before = smooth_part(explorer.prepared, base.fit)
    found = []
    for effect in final.effects if before is not None else ():
        left = of_a_wider_law(explorer.prepared, final.fit, effect)
        if left is None or before is None:
            continue
        too_much = left.excess_of_all > rules.law_share * before.excess_of_all
        if too_much and left.p_value < rules.law_significance:
            found.append(effect.name)
    return found


def _leaves_noise(explorer: Explorer, base: Candidate, final: Candidate, rules: Rules) -> bool:
    """Whether a candidate's residual is noise, on held-out trials where there are any."""
    prepared, noise_m = explorer.prepared, explorer.prepared.expected.std_m
    freedom = prepared.floor.freedom
    if prepared.noise_is_measured and prepared.floor.stated:
        return within_stated(prepared, final, rules)
    if final.fit.rms_m > rules.gross_misfit * noise_m:
        return False
    if final.heldout is not None and base.heldout is not None:
        chi2, count, rms_m = final.heldout.chi2, final.heldout.count, final.heldout.rms_m
        before_m = base.heldout.rms_m
        if not _smooth_part_explained(explorer, base, final, rules):
            return False
    else:
        count = prepared.count(fit_trials(prepared)) - len(final.fit.q)
        chi2, rms_m, before_m = final.fit.chi2, final.fit.rms_m, base.fit.rms_m
    ratio = max(rms_m / noise_m, float(np.sqrt(chi2 / count)))
    if _p_value(chi2, count, freedom) > rules.misfit_significance or ratio < rules.misfit:
        return True
    left = (rms_m**2 - noise_m**2) / max(before_m**2 - noise_m**2, 1e-30)
    return ratio < rules.gross_misfit and left < rules.misfit_share


def _smooth_part_explained(
    explorer: Explorer, base: Candidate, final: Candidate, rules: Rules
) -> bool:
    """Whether the smooth part of a candidate's residual is noise.

    There misfits of a model are, and little noise: a wrong effect in place of one that the library
    lacks shows here, though its whole residual looks like noise.  On the held-out trials; when
    fitted to all trials together, where a model leaves less, but more is known of the noise; and
    there in what each trial asks for, which must be noise too.
    """
    prepared = explorer.prepared
    before = smooth_part(prepared, base.fit)
    if before is None:
        return True
    shares = rules.smooth_shares if final is not base else ((0.0, rules.misfit_significance),)
    for look in (of_a_finer_model, of_all_trials_together, of_what_trials_ask_for):
        left = look(prepared, final.fit)
        if left is None:
            continue
        for share, significance in shares:
            too_much = left.excess_of_all > share * before.excess_of_all
            too_much |= left.excess_of_all > rules.gross_smooth_misfit
            if too_much and left.p_value < significance:
                return False
    return not broken_laws(explorer, base, final, rules)


def barely_seen(explorer: Explorer, final: Candidate, rules: Rules) -> tuple[str, ...]:
    """Effects found of which the trials would not notice that half was left.

    Another effect, which no library has, would pass there for the one found.
    """
    prepared = explorer.prepared

    def half_is_seen(before: SmoothPart | None) -> bool:
        return before is None or before.chance_of(0.5 * before.excess) < rules.half_seen

    def is_seen(without: Fit) -> bool:
        return (
            half_is_seen(of_a_finer_model(prepared, without))
            or half_is_seen(of_what_trials_ask_for(prepared, without))
            or half_is_seen(of_what_trials_ask_for(prepared, without, final.fit))
        )

    found = [e for e in final.effects if e not in explorer.space.effects]
    without = {e.name: explorer.without(final, e).fit for e in found}
    return tuple(name for name, fit in without.items() if not is_seen(fit))


def _p_value(chi2: float, count: int, freedom: float) -> float:
    """Of a χ² of `count` values whose unit is known from `freedom` others."""
    if np.isfinite(freedom):
        return float(f_sf(count, freedom, chi2 / count))
    return float(chi2_sf(count, chi2))


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
