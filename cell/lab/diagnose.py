"""Diagnosis: screen, refit, accept on held-out trials, one effect after another; then a verdict."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from cell.cable.effects.base import Effect
from cell.lab.estimate import Estimate, estimate
from cell.lab.explore import Candidate, Explorer, Gain
from cell.lab.fitting import Heldout, fit_trials
from cell.lab.results import Diagnosis, Errors, Found, Ranked, Status, Verdict
from cell.lab.score import holm
from cell.lab.screen import Screened


@dataclass(frozen=True)
class Rules:
    """When an effect is believed.

    significance     family-wise, over the library (Holm), on the fit trials
    heldout_gain     ln of how much likelier the held-out trials must become
    first_share, more_share, excess_share   least fall of the held-out mean square: of the noise's
                     for the first effect and for more, and of the baseline's excess for more.
                     Below lie the errors of models, ours included, whatever their significance
    tie              sets of effects are tied if their χ² over all trials differs by less
    most_tied        more than these tied: these motions cannot tell
    most_effects     added one after another
    best             of the screen that are refitted, besides all that are not smooth
    doubted          a stated noise of which a model leaves less than this share bounds what the
                     measurement can be trusted for: below it nothing more is claimed
    misfit_significance   of what a model leaves on the held-out trials
    misfit, gross_misfit  rms over noise from which that matters; and does whatever it was before
    misfit_share          of the baseline's excess that a known effect may leave below the latter
    smooth_misfit, gross_smooth_misfit, smooth_share   the same for the smooth part's mean square
    """

    significance: float = 0.01
    heldout_gain: float = 3.0
    first_share: float = 0.003
    more_share: float = 0.01
    excess_share: float = 0.001
    tie: float = 9.0
    most_tied: int = 3
    most_effects: int = 3
    best: int = 6
    doubted: float = 0.8
    misfit: float = 1.04
    gross_misfit: float = 1.10
    misfit_share: float = 0.1
    misfit_significance: float = 1e-3
    smooth_misfit: float = 0.01
    gross_smooth_misfit: float = 0.2
    smooth_share: float = 0.01


@dataclass(frozen=True, eq=False)
class Examination:
    """A diagnosis and the fits behind it, for the report.

    steps  the baseline, then with each effect added in the order of `diagnosis.missing`
    """

    diagnosis: Diagnosis
    steps: tuple[Candidate, ...]
    screened: tuple[Screened, ...]
    singles: tuple[Candidate, ...]


def diagnose(explorer: Explorer, rules: Rules = Rules()) -> Examination:
    """Which effects the model lacks.

    Forward: the effect with the most evidence is added while it is significant and confirmed on
    held-out trials.  Then every effect found is exchanged for every other while that brings
    evidence, and each is tested again with all others in.
    """
    base = explorer.baseline()
    screened = explorer.screened(base)
    singles = explorer.add(base, _worth_refitting(explorer, base, rules))
    current = base
    for _ in range(rules.most_effects):
        if _below_stated(explorer, current, rules):
            break
        options = explorer.add(current, _worth_refitting(explorer, current, rules))
        better = _accepted(explorer, current, options, len(screened), rules)
        if better is None:
            break
        current = _pruned(explorer, _exchanged(explorer, better, rules), rules)
    steps = _in_order(explorer, current)
    tied = {e.name: _tied(explorer, current, e, rules) for e in _added(explorer, current)}
    verdict = _verdict(explorer, base, current, tied, rules)
    if verdict == "unexplained":
        steps, tied = (base,), {}
    final = estimate(explorer.prepared, steps[-1].fit) if len(steps) > 1 else None
    missing = tuple(
        _found(explorer, small, large, tied, len(screened), final)
        for small, large in itertools.pairwise(steps)
        if final is not None
    )
    diagnosis = Diagnosis(
        noise_m=explorer.prepared.floor.noise.std_m,
        baseline=_errors(explorer.as_believed()),
        verdict=verdict,
        missing=missing,
        ranking=_ranking(explorer, base, steps[-1], singles, tied, rules),
    )
    return Examination(diagnosis, steps, tuple(screened), tuple(singles))


def _added(explorer: Explorer, candidate: Candidate) -> list[type[Effect]]:
    """Effects of a candidate that the baseline did not have already."""
    return [e for e in candidate.effects if e not in explorer.space.effects]


def _below_stated(explorer: Explorer, candidate: Candidate, rules: Rules) -> bool:
    """Whether a candidate errs by much less than the measurement is said to."""
    worst_m = max(candidate.fit.rms_m, candidate.heldout.rms_m if candidate.heldout else 0.0)
    floor = explorer.prepared.floor
    return bool(np.isinf(floor.freedom)) and worst_m < rules.doubted * floor.noise.std_m


def _worth_refitting(explorer: Explorer, base: Candidate, rules: Rules) -> list[type[Effect]]:
    """The best of the screen, and whatever the screen may misjudge: all that are not smooth."""
    screened = explorer.screened(base)
    ranked = sorted(screened, key=lambda s: (s.score.p_value, -s.score.statistic))
    best = [s.effect for s in ranked[: rules.best]]
    return best + [s.effect for s in ranked[rules.best :] if not s.effect.smooth]


def _accepted(
    explorer: Explorer,
    current: Candidate,
    options: Sequence[Candidate],
    library: int,
    rules: Rules,
) -> Candidate | None:
    """The option with the most evidence, if it is significant and confirmed.

    Effects that were not refitted count as tried: their screen was no better than chance.
    """
    gains = [explorer.gain(current, o) for o in options]
    tried = [g.p_value for g in gains]
    adjusted = holm(tried + [1.0] * (library - len(tried)))[: len(tried)]
    sound = [
        o
        for o, g, p in zip(options, gains, adjusted, strict=True)
        if p < rules.significance
        and g.delta_bic > 0.0
        and _confirmed(explorer, current, o, g, rules)
    ]
    return max(sound, key=lambda o: o.evidence) if sound else None


def _confirmed(
    explorer: Explorer, small: Candidate, large: Candidate, gain: Gain, rules: Rules
) -> bool:
    """Whether the held-out trials bear out the last effect of `large`, by enough to matter."""
    base = explorer.baseline().heldout
    if small.heldout is None or large.heldout is None or base is None:
        return True
    noise = explorer.prepared.noise.std_m**2
    least = rules.first_share * noise
    if _added(explorer, small):
        excess = max(base.rms_m**2 - noise, 0.0)
        least = max(rules.more_share * noise, rules.excess_share * excess)
    fall = small.heldout.rms_m**2 - large.heldout.rms_m**2
    return gain.heldout > rules.heldout_gain and fall > least


def _exchanged(explorer: Explorer, candidate: Candidate, rules: Rules) -> Candidate:
    """The candidate with effects exchanged one by one for others while evidence grows."""
    improved = len(_added(explorer, candidate)) > 1
    while improved:
        improved = False
        for effect in _added(explorer, candidate):
            rest = explorer.without(candidate, effect)
            options = explorer.add(rest, _worth_refitting(explorer, rest, rules))
            best = max(options, key=lambda c: c.evidence, default=candidate)
            if best.evidence > candidate.evidence + 1.0:
                candidate, improved = best, True
                break
    return candidate


def _pruned(explorer: Explorer, candidate: Candidate, rules: Rules) -> Candidate:
    """The candidate without effects that the others have made unnecessary."""
    for effect in _added(explorer, candidate)[:-1]:
        rest = explorer.without(candidate, effect)
        gain = explorer.gain(rest, candidate)
        if gain.delta_bic <= 0.0 or not _confirmed(explorer, rest, candidate, gain, rules):
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
    rivals = explorer.add(rest, _worth_refitting(explorer, rest, rules))
    limit = final.chi2 + rules.tie
    close = sorted((c for c in rivals if c.chi2 < limit), key=lambda c: c.chi2)
    names = [next(iter(c.names - rest.names)) for c in close]
    return tuple(name for name in names if name not in final.names)


def _verdict(
    explorer: Explorer,
    base: Candidate,
    final: Candidate,
    tied: dict[str, tuple[str, ...]],
    rules: Rules,
) -> Verdict:
    if not _explains(explorer, base, final, rules):
        return "unexplained"
    if final is base:
        return "complete"
    if final.heldout is None or any(len(t) + 1 > rules.most_tied for t in tied.values()):
        return "cannot_tell"
    return "missing"


def _explains(explorer: Explorer, base: Candidate, final: Candidate, rules: Rules) -> bool:
    """Whether a candidate's residual is noise, on held-out trials where there are any."""
    prepared, noise_m = explorer.prepared, explorer.prepared.noise.std_m
    freedom = prepared.floor.freedom
    if final.heldout is not None and base.heldout is not None:
        chi2, count, rms_m = final.heldout.chi2, final.heldout.count, final.heldout.rms_m
        before_m = base.heldout.rms_m
        if not _smooth_part_explained(explorer, base.heldout, final.heldout, rules):
            return False
    else:
        count = prepared.count(fit_trials(prepared)) - len(final.fit.q)
        chi2, rms_m, before_m = final.fit.chi2, final.fit.rms_m, base.fit.rms_m
    ratio = max(rms_m / noise_m, float(np.sqrt(chi2 / count)))
    if _p_value(chi2, count, freedom) > rules.misfit_significance or ratio < rules.misfit:
        return True
    left = (rms_m**2 - noise_m**2) / max(before_m**2 - noise_m**2, 1e-30)
    return ratio < rules.gross_misfit and left < rules.misfit_share


def _smooth_part_explained(explorer: Explorer, base: Heldout, final: Heldout, rules: Rules) -> bool:
    """Whether the smooth part of a candidate's residual is noise.

    There misfits of a model are, and little noise: a wrong effect in place of one that the library
    lacks shows here, though its whole residual looks like noise.  Where the noise is an earlier
    model's misfit, or a level that the study states, it may be smooth itself: this says nothing.
    """
    floor = explorer.prepared.floor
    if explorer.prepared.noise is not floor.noise or np.isinf(floor.freedom):
        return True
    before, left = ((h.smooth_chi2 - h.smooth_count) / h.count for h in (base, final))
    p_value = _p_value(final.smooth_chi2, final.smooth_count, floor.slow_freedom)
    if p_value > rules.misfit_significance or left < rules.smooth_misfit:
        return True
    return left < min(rules.gross_smooth_misfit, rules.smooth_share * before)


def _p_value(chi2: float, count: int, freedom: float) -> float:
    """Of a χ² of `count` values whose unit is known from `freedom` others."""
    if np.isfinite(freedom):
        return float(stats.f.sf(chi2 / count, count, freedom))
    return float(stats.chi2.sf(chi2, count))


def _found(
    explorer: Explorer,
    small: Candidate,
    large: Candidate,
    tied: dict[str, tuple[str, ...]],
    library: int,
    final: Estimate,
) -> Found:
    effect = next(e for e in large.effects if e.name not in small.names)
    gain = explorer.gain(small, large)
    return Found(
        effect=effect.name,
        tied_with=tied.get(effect.name, ()),
        p_value=min(1.0, gain.p_value * (library - len(small.effects))),
        delta_bic=gain.delta_bic,
        parameters=final.intervals(effect),
        errors=_errors(large),
    )


def _errors(candidate: Candidate) -> Errors:
    held = candidate.heldout
    return Errors(candidate.fit.rms_m, held.rms_m if held else float("nan"))


def _ranking(
    explorer: Explorer,
    base: Candidate,
    final: Candidate,
    singles: Sequence[Candidate],
    tied: dict[str, tuple[str, ...]],
    rules: Rules,
) -> tuple[Ranked, ...]:
    """All effects, by the evidence of adding each alone to the baseline."""
    refits = {c.effects[-1].name: c for c in singles}
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
    rivals = {name for names in tied.values() for name in names}
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
        ranked.append(Ranked(name, float(score), p_value, status))
    return tuple(ranked)


def _too_small(screened: Screened) -> bool:
    """Whether an effect of typical size would have been seen: every amplitude is well below it."""
    score = screened.score
    reach = np.abs(score.amplitude) + 1.96 * score.std
    sizes = [abs(p.starts[0] - p.default) for p in screened.effect.parameters if p.amplitude]
    return bool(np.all(reach < np.array(sizes)))
