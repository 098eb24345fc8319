"""What the effects that many cables do not tell apart foretell of the next cable."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.lab.data.cycles import RecordedCycle
from cell.lab.data.rival import Rival
from cell.lab.line.effect_fit import EffectFit
from cell.lab.line.learn import LearningResult


def asked(cycles: Sequence[RecordedCycle]) -> int:
    """How many of the cycles were measured with a motion of their own."""
    return sum(c.held is None for c in cycles)


def open_to(result: LearningResult) -> list[Rival]:
    """The effect found and those tied with it; none without ties."""
    if not result.tied:
        return []
    likeliest, *others = result.ranking
    tied = [t for t in others if t.effect.name in result.tied]
    return [_of_the_next_cable(t) for t in (likeliest, *tied)]


def _of_the_next_cable(tried: EffectFit) -> Rival:
    """What an effect foretells of a cable not seen yet: one like these, apart as these are."""
    fit, space = tried.fit, tried.fit.space
    n, own, common = len(fit.cables), fit.own, fit.common
    covariance = np.zeros((len(space.names), len(space.names)))
    for i in range(n):
        mine = slice(i * own, (i + 1) * own)
        covariance[:own, :own] += fit.inflation * fit.solution.covariance[mine, mine] / n
    if n > 1:
        covariance[:own, :own] += np.cov(fit.q.T)
    covariance[np.ix_(common, common)] = fit.covariance
    q = space.mean.copy()
    q[:own], q[common] = fit.q.mean(axis=0), fit.theta
    return Rival(tried.name, space, q, covariance)
