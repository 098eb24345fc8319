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
from cell.lab.search.explore import Candidate, Explorer, Gain
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
from cell.lab.verdict.leftover import leftover, removed_share
from cell.lab.verdict.partial import Partial, explain_partly, nearest, tied_so_far, what_is_left
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
    steps: tuple[Candidate, ...]
    screened: tuple[ScreenedEffect, ...]
    singles: tuple[Candidate, ...]
    accepted: Candidate
    final: Candidate
    weighed: PreparedStudy
    partial: tuple[Candidate, ...] = ()


def diagnose(explorer: Explorer, rules: Rules = DEFAULT_RULES) -> Examination:
    """Which effects the model lacks.

    Forward: the effect with the most evidence is added while it is significant and confirmed on
    held-out trials.  Then every effect found is exchanged for every other while that brings
    evidence, and each is tested again with all others in.

    raises  StoppedError, UnsimulatedError: before the baseline was fitted; later, what is known is
            returned
    """
    try:
        return _examined(explorer, rules)
    except StoppedError:
        if not explorer.recall():
            raise
        explorer.prepared.work.stopped = False
        return _so_far(explorer, rules)
    except UnsimulatedError:
        if not explorer.recall():
            raise
        base = explorer.baseline()
        return _unsearched(explorer, base, rules, "cannot_tell", unsimulated_doubt())


def _examined(explorer: Explorer, rules: Rules) -> Examination:
    base = explorer.baseline()
    _LOG.info("study %s, baseline: %s", explorer.prepared.study.name, _errors_in_words(base))
    if is_no_model(explorer, base.fit):
        return _unsearched(explorer, base, rules, "unexplained", no_model_doubt())
    screened = explorer.screened(base)
    singles = explorer.add(base, explorer.worth_refitting(base, rules.best))
    current, cut_short = _searched(explorer, base, len(screened), rules)
    if current is not base and explorer.settle_mesh(current):
        return _examined(explorer, rules)
    found = explains(Evidence(explorer, base, current, rules))
    tied: dict[str, tuple[str, ...]] = {}
    steps: tuple[Candidate, ...] = (base,)
    partial = Partial(explorer, tuple(singles), (base,))
    if found:
        current, tied = _without_anybodys(explorer, base, current, rules)
        steps = _in_order(explorer, current)
    else:
        partial = explain_partly(explorer, explorer.known(), len(screened), rules)
    evidence = Evidence(explorer, base, current, rules, tied)
    asked = tuple(answers(evidence))
    verdict = verdict_of(asked, evidence.is_base)
    rivals = {n for names in tied.values() for n in names}
    whole, most = partial.explorer, partial.steps
    also = {e.name: tied_so_far(whole, most[-1], e, rules) for e in _added(whole, most[-1])}
    final = current if found else most[-1]
    _LOG.info("verdict: %s", verdict)
    rivals |= {n for effect, names in also.items() for n in (effect, *names)}
    diagnosis = Diagnosis(
        noise_m=explorer.prepared.floor.noise.std_m,
        noise_is_stated=explorer.prepared.study.noise_std_m is not None,
        baseline=(base if verdict == "complete" else explorer.prior_candidate()).errors,
        verdict=verdict,
        missing=_all_found(explorer, steps, tied, len(screened)),
        ranking=_ranking(explorer, base, steps[-1], singles, rivals, rules),
        left=what_is_left(whole, most[0], final),
        partial=_all_found(whole, most, also, len(screened)),
        nearest=() if found else nearest(partial, _sound(singles, base), rules),
        warnings=(
            *doubts(explorer, whole, final, cut_short),
            *(doubt for answer in asked for doubt in answer.warnings(evidence)),
        ),
        checks=tuple(answer.result(evidence) for answer in asked),
    )
    return Examination(
        diagnosis, steps, tuple(screened), tuple(singles), current, final, whole.prepared, most
    )


def _so_far(explorer: Explorer, rules: Rules) -> Examination:
    """What is known of a study when its diagnosis is stopped, nothing of it confirmed."""
    base = explorer.baseline()
    tried = sum(len(c.names) == len(base.names) + 1 for c in explorer.known())
    doubt = interrupted_doubt(f"{tried} effects were fitted so far, nothing is confirmed")
    return _unsearched(explorer, base, rules, "cannot_tell", doubt)


def _unsearched(
    explorer: Explorer, base: Candidate, rules: Rules, verdict: Verdict, why: Doubt
) -> Examination:
    """What is known of a study without a search, or before its end; nothing of it is confirmed."""
    one_more = len(base.names) + 1
    singles = tuple(c for c in explorer.known() if len(c.names) == one_more)
    partial = Partial(explorer, singles, (base,))
    screened = tuple(explorer.screened(base))
    searched = why.code != "not_searched"
    diagnosis = Diagnosis(
        noise_m=explorer.prepared.floor.noise.std_m,
        noise_is_stated=explorer.prepared.study.noise_std_m is not None,
        baseline=base.errors,
        verdict=verdict,
        ranking=_ranking(explorer, base, base, singles, set(), rules) if searched else (),
        left=what_is_left(explorer, base, base),
        nearest=nearest(partial, _sound(singles, base), rules),
        warnings=(
            why,
            *doubts(explorer, explorer, base, cut_short=False),
        ),
    )
    return Examination(diagnosis, (base,), screened, singles, base, base, explorer.prepared)


def _sound(singles: Sequence[Candidate], base: Candidate) -> list[Candidate]:
    """Those that leave no more than the model without their effect: others ended anywhere."""
    return [c for c in singles if c.fit.objective <= base.fit.objective]


def _errors_in_words(candidate: Candidate) -> str:
    held = candidate.heldout
    beyond = "none held out" if held is None else f"{held.rms_m * 1e3:.4f} mm held out"
    return f"{candidate.fit.rms_m * 1e3:.4f} mm fitted, {beyond}"


def _searched(
    explorer: Explorer, base: Candidate, library: int, rules: Rules
) -> tuple[Candidate, bool]:
    """The baseline with the effects that are believed; whether the search was cut short."""
    current = base
    for _ in range(rules.most_effects):
        if Evidence(explorer, explorer.baseline(), current, rules).below_stated:
            break
        if _hopeless_search(explorer, current, rules, rules.hopeless_left):
            break
        spent = explorer.prepared.work.simulated_s > rules.most_simulated_s
        if spent and current is not base:  # beside the baseline, all were refitted already
            return current, True
        options = explorer.add(current, explorer.worth_refitting(current, rules.best))
        better = _accepted(explorer, current, options, library, rules)
        if better is None:
            break
        if not _hopeless_search(explorer, better, rules, rules.unexchanged_left):
            better = _exchanged(explorer, better, rules)
        current = _pruned(explorer, better, rules)
        _LOG.info("with %s: %s", ", ".join(sorted(current.names)), _errors_in_words(current))
    return current, False


def _hopeless_search(
    explorer: Explorer, current: Candidate, rules: Rules, most_left: float
) -> bool:
    """Whether no further effect, nor another for one found, can be hoped to leave noise.

    So it is if two have been found, and still more than a share `most_left` of the error is left.
    """
    if len(current.names) - len(explorer.space.effects) < rules.first_effects:
        return False
    prepared = explorer.prepared
    before, after = leftover(prepared, explorer.baseline()), leftover(prepared, current)
    left = 1.0 - removed_share(prepared.floor.noise.std_m, before, after)
    return left > most_left


def _added(explorer: Explorer, candidate: Candidate) -> list[type[Effect]]:
    """Effects of a candidate that the baseline did not have already."""
    return [e for e in candidate.effects if e not in explorer.space.effects]


def _accepted(
    explorer: Explorer,
    current: Candidate,
    options: Sequence[Candidate],
    library: int,
    rules: Rules,
) -> Candidate | None:
    """The option with the most evidence, if it is significant and confirmed.

    Where there is none, one that the held-out trials are blind to.  Effects that were not refitted
    count as tried: their screen was no better than chance.
    """
    gains = [explorer.gain(current, o) for o in options]
    tried = [g.p_value for g in gains]
    adjusted = holm(tried + [1.0] * (library - len(tried)))[: len(tried)]
    likely = [
        (o, g)
        for o, g, p in zip(options, gains, adjusted, strict=True)
        if p < rules.significance and g.delta_bic > 0.0
    ]
    sound = [o for o, g in likely if _confirmed(explorer, current, o, g, rules)]
    if not sound:
        sound = [o for o, g in likely if _unseen(explorer, current, o, g, rules)]
    return max(sound, key=lambda o: o.evidence) if sound else None


def _confirmed(
    explorer: Explorer, small: Candidate, large: Candidate, gain: Gain, rules: Rules
) -> bool:
    """Whether the held-out trials bear out the last effect of `large`, by enough to matter."""
    base = explorer.baseline().heldout
    if small.heldout is None or large.heldout is None or base is None:
        return True
    noise = explorer.prepared.expected.std_m**2
    least = rules.first_share * noise
    if _added(explorer, small):
        excess = max(base.rms_m**2 - noise, 0.0)
        least = max(rules.more_share * noise, rules.excess_share * excess)
    fall = small.heldout.rms_m**2 - large.heldout.rms_m**2
    if not (gain.heldout > rules.heldout_gain and fall > least):
        return False
    return explorer.visible(large, added_effect(small, large)) > rules.least_visible


def _unseen(
    explorer: Explorer, small: Candidate, large: Candidate, gain: Gain, rules: Rules
) -> bool:
    """Whether the held-out trials are blind to an effect that the others show plainly."""
    if large.heldout is None or gain.heldout < -rules.heldout_gain:
        return False
    seen = explorer.visible(large, added_effect(small, large))
    return seen < rules.least_visible and 2.0 * seen < rules.blind * gain.delta_chi2


def _exchanged(explorer: Explorer, candidate: Candidate, rules: Rules) -> Candidate:
    """The candidate with effects exchanged one by one for others while evidence grows."""
    improved = len(_added(explorer, candidate)) > 1
    while improved and explorer.prepared.work.simulated_s < rules.most_simulated_s:
        improved = False
        for effect in _added(explorer, candidate):
            rest = explorer.without(candidate, effect)
            options = explorer.add(rest, explorer.worth_refitting(rest, rules.best))
            best = max(options, key=lambda c: c.evidence, default=candidate)
            if best.evidence > candidate.evidence + 1.0:
                candidate, improved = best, True
                break
    return candidate


def _pruned(explorer: Explorer, candidate: Candidate, rules: Rules) -> Candidate:
    """The candidate without effects that the others have made unnecessary."""
    for effect in _added(explorer, candidate):
        rest = explorer.without(candidate, effect)
        gain = explorer.gain(rest, candidate)
        kept = _confirmed(explorer, rest, candidate, gain, rules) or _unseen(
            explorer, rest, candidate, gain, rules
        )
        if gain.delta_bic <= 0.0 or not kept:
            return _pruned(explorer, rest, rules)
    return candidate


def _in_order(explorer: Explorer, final: Candidate) -> tuple[Candidate, ...]:
    """From the baseline to `final`, the effect with the most evidence first."""
    steps = [final]
    while added := _added(explorer, steps[0]):
        smaller = [explorer.without(steps[0], e) for e in added]
        steps.insert(0, max(smaller, key=lambda c: c.evidence))
    return tuple(steps)


def _tied(
    explorer: Explorer,
    final: Candidate,
    effect: type[Effect],
    rules: Rules,
) -> tuple[str, ...]:
    """Effects that explain as much in place of `effect`, all trials together."""
    rest = explorer.without(final, effect)
    rivals = explorer.add(rest, explorer.worth_refitting(rest, rules.best))
    close = close_rivals(explorer, final, rivals, rules)
    names = [next(iter(c.names - rest.names)) for c in close]
    return tuple(name for name in names if name not in final.names)


def _without_anybodys(
    explorer: Explorer, base: Candidate, found: Candidate, rules: Rules
) -> tuple[Candidate, dict[str, tuple[str, ...]]]:
    """What was found, and the ties of each effect, without one that too many others could be.

    Not the only one, and only if what was found explains the study without it too: what any of
    many effects does as well is none of them in particular.
    """
    added = _added(explorer, found)
    tied = {e.name: _tied(explorer, found, e, rules) for e in added}
    for effect in added if len(added) > 1 else ():
        if len(tied[effect.name]) + 1 > rules.most_tied:
            rest = explorer.without(found, effect)
            if explains(Evidence(explorer, base, rest, rules)):
                return _without_anybodys(explorer, base, rest, rules)
    return found, tied


def _all_found(
    explorer: Explorer,
    steps: Sequence[Candidate],
    tied: dict[str, tuple[str, ...]],
    library: int,
) -> tuple[MissingEffect, ...]:
    """What each step after the first has added."""
    if len(steps) == 1:
        return ()
    final = estimate(explorer.prepared, steps[-1].fit, explorer.library.values())
    noise_m = explorer.prepared.floor.noise.std_m
    left = [leftover(explorer.prepared, c) for c in steps]
    return tuple(
        replace(
            _found(explorer, small, large, tied, library, final),
            explained_share=removed_share(noise_m, left[0], after),
        )
        for (small, large), after in zip(itertools.pairwise(steps), left[1:], strict=True)
    )


def _found(
    explorer: Explorer,
    small: Candidate,
    large: Candidate,
    tied: dict[str, tuple[str, ...]],
    library: int,
    final: Estimate,
) -> MissingEffect:
    effect = added_effect(small, large)
    gain = explorer.gain(small, large)
    p_value = gain.p_value
    if above_noise(explorer, large) > DEFAULT_RULES.misfit:
        p_value = max(p_value, chance_of(explorer, small, large))
    return MissingEffect(
        effect=effect.name,
        tied_with=tied.get(effect.name, ()),
        p_value=min(1.0, p_value * (library - len(small.effects))),
        delta_bic=gain.delta_bic,
        parameters=final.intervals(effect),
        errors=large.errors,
    )


def _ranking(
    explorer: Explorer,
    base: Candidate,
    final: Candidate,
    singles: Sequence[Candidate],
    rivals: set[str],
    rules: Rules,
) -> tuple[RankedEffect, ...]:
    """All effects, by the evidence of adding each alone to the baseline."""
    refits = {c.effects[-1].name: c for c in _sound(singles, base)}
    rows = []
    for screened in explorer.screened(base):
        name = screened.effect.name
        if name in refits:
            gain = explorer.gain(base, refits[name])
            rows.append((name, gain.delta_chi2, gain.p_value, refits[name].evidence))
        else:
            rows.append((name, screened.score.statistic, screened.score.p_value, -np.inf))
    adjusted = holm([row[2] for row in rows])
    at_end = {s.effect.name: s for s in explorer.screened(final)}
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
