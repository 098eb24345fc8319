"""Where fits of an effect to many cables begin: where all show it, or where single cables do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit
from cell.lab.fit.sensitivity import shapes_of
from cell.lab.fit.shared import PASSES, SharedFit, fit_shared
from cell.lab.line.effect_fit import EffectFit, natural
from cell.lab.search.fitted_model import FittedModel
from cell.lab.search.screen import ScreenedEffect

#: Starts of a fit are compared on so many cables, with so many passes.
START_ON, FIRST_PASSES = 1, replace(PASSES, tolerance=1.0, max_iterations=6)
#: Of an effect with more shapes than this a refit begins with several, the likeliest of the cable
#: that shows it best: the middle of what cables show is none of them.
SEVERAL, PLACES = 12, 3
#: Share of what the slope says that a refit begins with.
A_LITTLE = 0.05
#: Two cables' own solutions are one if they differ by fewer standard deviations in every parameter.
ALIKE = 3.0


def common_start(
    prepared: Sequence[PreparedStudy],
    base: ParameterSpace,
    plausible: FloatArray,
    simpler: EffectFit | None,
    effect: type[Effect],
    screened: Sequence[ScreenedEffect],
) -> tuple[FloatArray, FloatArray]:
    """Cables' coordinates and the effects' values that lead furthest on a few of the cables."""
    effects = (effect,) if simpler is None else (*simpler.effects, effect)
    known = np.zeros(0) if simpler is None else natural(simpler.fit)
    # The slope says how much of it there is, but the cables were fitted without it: from a
    # little of it all parameters move together.
    off = np.array([p.default if p.amplitude else np.nan for p in effect.parameters])
    most = [np.median(np.array([s.starts[0] for s in screened]), axis=0)]
    if shapes_of(effect) > SEVERAL:
        clearest = max(screened, key=lambda s: s.score.statistic)
        most = [*clearest.starts[:PLACES]]
    places = [np.where(np.isnan(off), m, off + A_LITTLE * (m - off)) for m in most]
    if not effect.smooth:
        places += [
            np.array([p.starts[min(k, len(p.starts) - 1)] for p in effect.parameters])
            for k in range(3)
        ]
    starts = [np.concatenate([known, values]) for values in places]
    few, q = slice(0, START_ON), plausible
    found: list[SharedFit] = []
    for values in starts if len(starts) > 1 else ():
        try:
            found.append(
                fit_shared(prepared[few], base, q[few], effects, values, options=FIRST_PASSES)
            )
        except UNSIMULATED:
            continue
    begin, values = q.copy(), starts[0]
    if found:
        best = min(found, key=lambda f: f.chi2)
        begin[few], values = best.q, natural(best)
    return begin, values


def values_of(fit: Fit, effects: Sequence[type[Effect]]) -> FloatArray:
    """Natural values of all parameters of these effects in a fit."""
    values = fit.space.natural(fit.q)
    names = [f"{e.name}.{p.name}" for e in effects for p in e.parameters]
    return np.array([values[fit.space.names.index(name)] for name in names])


def distinct(
    candidates: Sequence[FittedModel], effects: Sequence[type[Effect]]
) -> list[FittedModel]:
    """Own solutions, the clearest first, without those that say the same of the effects.

    A candidate's covariance is widened by what it leaves.
    """
    kept: list[tuple[FittedModel, FloatArray, FloatArray]] = []
    for candidate in sorted(candidates, key=lambda c: c.fit.objective):
        fit = candidate.fit
        names = [n for n in fit.space.names if n.startswith(tuple(f"{e.name}." for e in effects))]
        index = [fit.space.names.index(n) for n in names]
        q, variance = fit.q[index], fit.widening * np.diag(fit.covariance)[index]
        apart = [(q - a) ** 2 > ALIKE**2 * (variance + b) for _, a, b in kept]
        if all(np.any(far) for far in apart):
            kept.append((candidate, q, variance))
    return [candidate for candidate, *_ in kept]
