"""Effects of a diagnosis as results: those found with their strength, and all others ranked."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cell.lab.data.results import MissingEffect, RankedEffect, Status
from cell.lab.data.thresholds import Rules
from cell.lab.search.fit_cache import FitCache
from cell.lab.search.fitted_model import FittedModel
from cell.lab.search.screen import ScreenedEffect
from cell.lab.statistics.score import holm
from cell.lab.strength.estimate import ParameterEstimate, estimate
from cell.lab.verdict.evidence import above_noise
from cell.lab.verdict.fit_doubts import is_meaningless
from cell.lab.verdict.residual_summary import removed_share, residual_summary
from cell.lab.verdict.rivals import added_effect, chance_of


def sound(singles: Sequence[FittedModel], base: FittedModel) -> list[FittedModel]:
    """Those that leave no more than the model without their effect: others ended anywhere."""
    return [c for c in singles if c.fit.objective <= base.fit.objective]


def all_found(
    fits: FitCache,
    steps: Sequence[FittedModel],
    tied: Mapping[str, Sequence[str]],
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
    tied: Mapping[str, Sequence[str]],
    library: int,
    final: ParameterEstimate,
    rules: Rules,
) -> MissingEffect:
    effect = added_effect(small, large)
    gain = fits.gain(small, large)
    p_value = gain.p_value
    if above_noise(fits, large) > rules.most_over_noise:
        p_value = max(p_value, chance_of(fits, small, large))
    return MissingEffect(
        effect=effect.name,
        tied_with=tuple(tied.get(effect.name, ())),
        p_value=min(1.0, p_value * (library - len(small.effects))),
        delta_bic=gain.delta_bic,
        parameters=final.intervals(effect),
        errors=large.errors,
    )


def ranked(
    fits: FitCache,
    base: FittedModel,
    final: FittedModel,
    singles: Sequence[FittedModel],
    rivals: set[str],
    rules: Rules,
) -> tuple[RankedEffect, ...]:
    """All effects, by the evidence of adding each alone to the baseline.

    None is absent beside a final model whose parameters mean nothing.
    """
    refits = {c.effects[-1].name: c for c in sound(singles, base)}
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
    excludes = not is_meaningless(fits, final)
    ranked = []
    order = sorted(zip(rows, adjusted, strict=True), key=lambda r: (-r[0][3], -r[0][1]))
    for (name, score, _, _), p_value in order:
        status: Status
        if name in final.names:
            status = "present"
        elif name in rivals or left[name] < rules.significance:
            status = "inspect"
        else:
            excluded = excludes and _too_small(at_end[name])
            status = "absent" if excluded else "cannot_tell"
        ranked.append(RankedEffect(name, float(score), p_value, status))
    return tuple(ranked)


def _too_small(screened: ScreenedEffect) -> bool:
    """Whether an effect of typical size would have been seen: every amplitude is well below it."""
    score = screened.score
    reach = np.abs(score.amplitude) + 1.96 * score.std
    sizes = [abs(p.starts[0] - p.default) for p in screened.effect.parameters if p.amplitude]
    return bool(np.all(reach < np.array(sizes)))
