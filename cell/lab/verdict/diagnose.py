"""Diagnosis: screen, refit, accept on held-out trials, one effect after another; then a verdict."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UnsimulatedError
from cell.lab.data.prepared import PreparedStudy, StoppedError
from cell.lab.data.results import Diagnosis, Doubt, MissingEffect, RankedEffect, Status, Verdict
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel, Gain
from cell.lab.search.screen import ScreenedEffect
from cell.lab.statistics.score import holm
from cell.lab.strength.estimate import Estimate, estimate
from cell.lab.verdict.checks import answers, explains, verdict_of
from cell.lab.verdict.doubts import (
    doubts,
    interrupted_doubt,
    is_no_model,
    no_model_doubt,
    unsimulated_doubt,
)
from cell.lab.verdict.evidence import Evidence, above_noise
from cell.lab.verdict.partial import Partial, explain_partly, nearest, tied_so_far, what_is_left
from cell.lab.verdict.residual_summary import removed_share, residual_summary
from cell.lab.verdict.rivals import added_effect, chance_of, close_rivals
from cell.lab.verdict.rules import DEFAULT_RULES, Rules

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Examination:
    """A diagnosis and the fits behind it, for the report.

    steps     the baseline, then with each effect added in the order of `diagnosis.missing`
    accepted  with every effect that is significant and confirmed, even if they do not explain all
    final     the model that explains most: with `diagnosis.missing` in, or else `diagnosis.partial`
    weighed   the study as `final` was fitted to it
    partial   the same as `steps` for `diagnosis.partial`
    """

    diagnosis: Diagnosis
    steps: tuple[FittedModel, ...]
    screened: tuple[ScreenedEffect, ...]
    singles: tuple[FittedModel, ...]
    accepted: FittedModel
    final: FittedModel
    weighed: PreparedStudy
    partial: tuple[FittedModel, ...] = ()


def diagnose(fits: FitCache, rules: Rules = DEFAULT_RULES) -> Examination:
    """Which effects the model lacks.

    Forward: the effect with the most evidence is added while it is significant and confirmed on
    held-out trials.  Then every effect found is exchanged for every other while that brings
    evidence, and each is tested again with all others in.

    raises  StoppedError, UnsimulatedError: before the baseline was fitted; later, what is known is
            returned
    """
    try:
        return _examined(fits, rules)
    except StoppedError:
        if not fits.recall():
            raise
        fits.prepared.work.stopped = False
        return _so_far(fits, rules)
    except UnsimulatedError:
        if not fits.recall():
            raise
        base = fits.baseline()
        return _unsearched(fits, base, rules, "cannot_tell", unsimulated_doubt())


def _examined(fits: FitCache, rules: Rules) -> Examination:
    base = fits.baseline()
    _LOG.info("study %s, baseline: %s", fits.prepared.study.name, _errors_in_words(base))
    if is_no_model(fits, base.fit):
        return _unsearched(fits, base, rules, "unexplained", no_model_doubt())
    screened = fits.screened(base)
    singles = fits.fit_extended(base, fits.shortlist(base, rules.max_refits))
    current, cut_short = _searched(fits, base, len(screened), rules)
    if current is not base and fits.settle_mesh(current):
        return _examined(fits, rules)
    found = explains(Evidence(fits, base, current, rules))
    tied: dict[str, tuple[str, ...]] = {}
    steps: tuple[FittedModel, ...] = (base,)
    partial = Partial(fits, tuple(singles), (base,))
    if found:
        current, tied = with_ties(fits, base, current, rules)
        steps = _in_order(fits, current)
    else:
        partial = explain_partly(fits, fits.known(), len(screened), rules)
    evidence = Evidence(fits, base, current, rules, tied)
    asked = tuple(answers(evidence))
    verdict = verdict_of(asked, evidence.is_base)
    rivals = {n for names in tied.values() for n in names}
    whole, most = partial.fits, partial.steps
    also = {e.name: tied_so_far(whole, most[-1], e, rules) for e in _added(whole, most[-1])}
    final = current if found else most[-1]
    _LOG.info("verdict: %s", verdict)
    rivals |= {n for effect, names in also.items() for n in (effect, *names)}
    diagnosis = Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=(base if verdict == "complete" else fits.prior_candidate()).errors,
        verdict=verdict,
        missing=_all_found(fits, steps, tied, len(screened), rules),
        ranking=_ranking(fits, base, steps[-1], singles, rivals, rules),
        left=what_is_left(whole, most[0], final),
        partial=_all_found(whole, most, also, len(screened), rules),
        nearest=() if found else nearest(partial, _sound(singles, base), rules),
        warnings=(
            *doubts(fits, whole, final, cut_short),
            *(doubt for answer in asked for doubt in answer.warnings(evidence)),
        ),
        checks=tuple(answer.result(evidence) for answer in asked),
    )
    return Examination(
        diagnosis, steps, tuple(screened), tuple(singles), current, final, whole.prepared, most
    )


def _so_far(fits: FitCache, rules: Rules) -> Examination:
    """What is known of a study when its diagnosis is stopped, nothing of it confirmed."""
    base = fits.baseline()
    tried = sum(len(c.names) == len(base.names) + 1 for c in fits.known())
    doubt = interrupted_doubt(f"{tried} effects were fitted so far, nothing is confirmed")
    return _unsearched(fits, base, rules, "cannot_tell", doubt)


def _unsearched(
    fits: FitCache, base: FittedModel, rules: Rules, verdict: Verdict, why: Doubt
) -> Examination:
    """What is known of a study without a search, or before its end; nothing of it is confirmed."""
    one_more = len(base.names) + 1
    singles = tuple(c for c in fits.known() if len(c.names) == one_more)
    partial = Partial(fits, singles, (base,))
    screened = tuple(fits.screened(base))
    searched = why.code != "not_searched"
    diagnosis = Diagnosis(
        noise_m=fits.prepared.noise_model.noise.std_m,
        noise_is_stated=fits.prepared.study.noise_std_m is not None,
        baseline=base.errors,
        verdict=verdict,
        ranking=_ranking(fits, base, base, singles, set(), rules) if searched else (),
        left=what_is_left(fits, base, base),
        nearest=nearest(partial, _sound(singles, base), rules),
        warnings=(
            why,
            *doubts(fits, fits, base, cut_short=False),
        ),
    )
    return Examination(diagnosis, (base,), screened, singles, base, base, fits.prepared)


def _sound(singles: Sequence[FittedModel], base: FittedModel) -> list[FittedModel]:
    """Those that leave no more than the model without their effect: others ended anywhere."""
    return [c for c in singles if c.fit.objective <= base.fit.objective]


def _errors_in_words(candidate: FittedModel) -> str:
    held = candidate.heldout
    beyond = "none held out" if held is None else f"{held.rms_m * 1e3:.4f} mm held out"
    return f"{candidate.fit.rms_m * 1e3:.4f} mm fitted, {beyond}"


def _searched(
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
        _LOG.info("with %s: %s", ", ".join(sorted(current.names)), _errors_in_words(current))
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


def _added(fits: FitCache, candidate: FittedModel) -> list[type[Effect]]:
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
    if _added(fits, small):
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
    improved = len(_added(fits, candidate)) > 1
    while improved and fits.prepared.work.simulated_s < rules.max_simulated_s:
        improved = False
        for effect in _added(fits, candidate):
            rest = fits.fit_reduced(candidate, effect)
            options = fits.fit_extended(rest, fits.shortlist(rest, rules.max_refits))
            best = max(options, key=lambda c: c.evidence, default=candidate)
            if best.evidence > candidate.evidence + 1.0:
                candidate, improved = best, True
                break
    return candidate


def _pruned(fits: FitCache, candidate: FittedModel, rules: Rules) -> FittedModel:
    """The candidate without effects that the others have made unnecessary."""
    for effect in _added(fits, candidate):
        rest = fits.fit_reduced(candidate, effect)
        gain = fits.gain(rest, candidate)
        kept = _confirmed(fits, rest, candidate, gain, rules) or _unseen(
            fits, rest, candidate, gain, rules
        )
        if gain.delta_bic <= 0.0 or not kept:
            return _pruned(fits, rest, rules)
    return candidate


def _in_order(fits: FitCache, final: FittedModel) -> tuple[FittedModel, ...]:
    """From the baseline to `final`, the effect with the most evidence first."""
    steps = [final]
    while added := _added(fits, steps[0]):
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
    added = _added(fits, found)
    tied = {e.name: _tied(fits, found, e, rules) for e in added}
    for effect in added if len(added) > 1 else ():
        if len(tied[effect.name]) + 1 > rules.max_tied:
            rest = fits.fit_reduced(found, effect)
            if explains(Evidence(fits, base, rest, rules)):
                return with_ties(fits, base, rest, rules)
    return found, tied


def _all_found(
    fits: FitCache,
    steps: Sequence[FittedModel],
    tied: dict[str, tuple[str, ...]],
    library: int,
    rules: Rules,
) -> tuple[MissingEffect, ...]:
    """What each step after the first has added."""
    if len(steps) == 1:
        return ()
    final = estimate(fits.prepared, steps[-1].fit, fits.library.values())
    noise_m = fits.prepared.noise_model.noise.std_m
    left = [residual_summary(fits.prepared, c) for c in steps]
    return tuple(
        replace(
            _found(fits, small, large, tied, library, final, rules),
            explained_share=removed_share(noise_m, left[0], after),
        )
        for (small, large), after in zip(itertools.pairwise(steps), left[1:], strict=True)
    )


def _found(
    fits: FitCache,
    small: FittedModel,
    large: FittedModel,
    tied: dict[str, tuple[str, ...]],
    library: int,
    final: Estimate,
    rules: Rules,
) -> MissingEffect:
    effect = added_effect(small, large)
    gain = fits.gain(small, large)
    p_value = gain.p_value
    if above_noise(fits, large) > rules.misfit:
        p_value = max(p_value, chance_of(fits, small, large))
    return MissingEffect(
        effect=effect.name,
        tied_with=tied.get(effect.name, ()),
        p_value=min(1.0, p_value * (library - len(small.effects))),
        delta_bic=gain.delta_bic,
        parameters=final.intervals(effect),
        errors=large.errors,
    )


def _ranking(
    fits: FitCache,
    base: FittedModel,
    final: FittedModel,
    singles: Sequence[FittedModel],
    rivals: set[str],
    rules: Rules,
) -> tuple[RankedEffect, ...]:
    """All effects, by the evidence of adding each alone to the baseline."""
    refits = {c.effects[-1].name: c for c in _sound(singles, base)}
    rows = []
    for screened in fits.screened(base):
        name = screened.effect.name
        if name in refits:
            gain = fits.gain(base, refits[name])
            rows.append((name, gain.delta_chi2, gain.p_value, refits[name].evidence))
        else:
            rows.append((name, screened.score.statistic, screened.score.p_value, -np.inf))
    adjusted = holm([row[2] for row in rows])
    at_end = {s.effect.name: s for s in fits.screened(final)}
    left = dict(zip(at_end, holm([s.score.p_value for s in at_end.values()]), strict=True))
    ranked = []
    order = sorted(zip(rows, adjusted, strict=True), key=lambda r: (-r[0][3], -r[0][1]))
    for (name, score, _, _), p_value in order:
        status: Status
        if name in final.names:
            status = "present"
        elif name in rivals or left[name] < rules.significance:
            status = "inspect"
        else:
            status = "absent" if _too_small(at_end[name]) else "cannot_tell"
        ranked.append(RankedEffect(name, float(score), p_value, status))
    return tuple(ranked)


def _too_small(screened: ScreenedEffect) -> bool:
    """Whether an effect of typical size would have been seen: every amplitude is well below it."""
    score = screened.score
    reach = np.abs(score.amplitude) + 1.96 * score.std
    sizes = [abs(p.starts[0] - p.default) for p in screened.effect.parameters if p.amplitude]
    return bool(np.all(reach < np.array(sizes)))
