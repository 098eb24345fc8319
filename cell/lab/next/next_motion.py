"""The motion for the next cable that distinguishes tied effects of `cell learn`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cell.lab.data.cycles import RecordedCycle
from cell.lab.data.progress import Progress, no_progress
from cell.lab.line.effect_fit import EffectFit
from cell.lab.line.learn import LearningResult
from cell.lab.next.suggest import MOST_CANDIDATES, Option, Rival, Suggestion, telling_motions
from cell.settings.surroundings import Surroundings

#: Motions that are asked for, one after another, at most.
MOST_ASKED = 2
#: A motion that decides less likely is not worth a cable.
LEAST_POWER = 0.5


def asked(cycles: Sequence[RecordedCycle]) -> int:
    """How many of the cycles were measured with a motion of their own."""
    return sum(c.held is None for c in cycles)


def motion_that_tells(
    lesson: LearningResult, surroundings: Surroundings, progress: Progress = no_progress
) -> Suggestion | None:
    """Motions that distinguish the lesson's effect from those tied with it; None = no ties.

    raises  ValueError: no motion keeps the limits
    """
    if not lesson.tied:
        return None
    likeliest, *others = lesson.ranking
    tied = [t for t in others if t.effect.name in lesson.tied]
    open_to = [_of_the_next_cable(t) for t in (likeliest, *tied)][:MOST_CANDIDATES]
    return telling_motions(likeliest.fit.cables[0], open_to, surroundings, progress)


def worth_it(suggestion: Suggestion) -> Option | None:
    """The motion to be asked for, unless none is likely to decide."""
    best = suggestion.options[0]
    return best if best.power >= LEAST_POWER else None


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
