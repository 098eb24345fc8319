"""Profile likelihood: the rise of −2 ln L while one parameter is held at other values.

Where the fit is not linear in its parameters, or one of them hardly matters, this is the interval,
and the symmetric one from the curvature at the minimum is not.
source  Venzon & Moolgavkar 1988, Appl. Stat. 37, 87; Raue et al. 2009, Bioinformatics 25, 1923
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri as normal_quantile

from cell.cable.arrays import FloatArray
from cell.identify.gauss_newton import UNSIMULATED, LeastSquaresProblem, Options, Solution, minimise

CONFIDENCE = 0.95
#: Distance of the first point on a side from the minimum, in standard deviations.
FIRST = 0.5
#: Most points outwards on a side, and largest ratio between the distances of consecutive points
#: from the minimum; a profile that has not risen 3⁷ standard deviations away is flat.
MOST_POINTS = 9
FARTHER = 3.0
#: The interval's end is searched between two points until one of them is this near to 95 %, in
#: standard deviations, with so many further points at most.
NEAR = 0.05
MOST_BETWEEN = 6
TARGET = float(normal_quantile(0.5 + 0.5 * CONFIDENCE))
#: A fit better than the initial one by this, in standard deviations, is another minimum.
BETTER = 0.1


@dataclass(frozen=True)
class ProfilePoint:
    """The best fit with one parameter held at a value.

    q         where it is held
    rise      of the objective above the minimum
    at_bound  indices of other parameters that are at a bound there: beyond such a point the bound
              changes the rise, not the data alone
    """

    q: float
    rise: float
    at_bound: tuple[int, ...] = ()


@dataclass(frozen=True)
class LikelihoodProfile:
    """Profile likelihood of one parameter: its points, their minimum, and the 95 % interval.

    low, high   -∞ or ∞ where no value is excluded; the parameter's bound if that ends the interval
    better      whether a lower minimum was met on the way: the fit was not at its minimum
    """

    points: tuple[ProfilePoint, ...]
    low: float
    high: float
    better: bool


def profile(
    problem: LeastSquaresProblem, solution: Solution, index: int, options: Options
) -> LikelihoodProfile:
    """The profile of parameter `index` around a minimum, to both sides until 95 % is excluded.

    problem   its residuals white and of unit size
    solution  its minimum
    """
    best = ProfilePoint(float(solution.q[index]), 0.0)
    lower, low = _side(problem, solution, index, -1.0, options)
    upper, high = _side(problem, solution, index, 1.0, options)
    points = (*reversed(lower), best, *upper)
    return LikelihoodProfile(points, low, high, any(p.rise < -(BETTER**2) for p in points))


def _side(
    problem: LeastSquaresProblem, solution: Solution, index: int, sign: float, options: Options
) -> tuple[list[ProfilePoint], float]:
    """Points to one side, outwards, and where the interval ends there."""
    bound = float((problem.low if sign < 0.0 else problem.high)[index])
    begin = float(solution.q[index])
    points: list[ProfilePoint] = []
    start = solution.q

    def deviation(reach: float) -> float:
        """Root of the rise so far away, in standard deviations; ∞ if it cannot be simulated."""
        nonlocal start
        held = begin + sign * reach
        there = _held(problem, start, index, held, options)
        if there is None:
            return np.inf
        rise = there.objective - solution.objective
        met = np.flatnonzero(solution.free & ~there.free).tolist()
        points.append(ProfilePoint(held, rise, tuple(i for i in met if i != index)))
        start = there.q
        return float(np.sqrt(max(rise, 0.0)))

    inside, outside = _bracket(
        deviation, float(np.sqrt(solution.covariance[index, index])), abs(bound - begin)
    )
    points.sort(key=lambda p: abs(p.q - begin))
    if outside is None:
        return points, bound if inside[0] >= abs(bound - begin) else sign * np.inf
    for _ in range(MOST_BETWEEN):
        if min(TARGET - inside[1], outside[1] - TARGET) < NEAR:
            break
        share = 0.5
        if np.isfinite(outside[1]):
            share = float(np.clip((TARGET - inside[1]) / (outside[1] - inside[1]), 0.2, 0.8))
        reach = inside[0] + share * (outside[0] - inside[0])
        there = (reach, deviation(reach))
        inside, outside = (there, outside) if there[1] < TARGET else (inside, there)
    points.sort(key=lambda p: abs(p.q - begin))
    share = (TARGET - inside[1]) / (outside[1] - inside[1])
    return points, begin + sign * (inside[0] + share * (outside[0] - inside[0]))


def _bracket(
    deviation: Callable[[float], float], std: float, farthest: float
) -> tuple[tuple[float, float], tuple[float, float] | None]:
    """The last point inside the interval and the first outside: distance, deviation.

    None if there is none before `farthest`, or among `MOST_POINTS`.
    """
    inside, reach = (0.0, 0.0), min(FIRST * std, farthest)
    for _ in range(MOST_POINTS):
        if inside[0] >= farthest:
            break
        now = deviation(reach)
        if now >= TARGET:
            return inside, (reach, now)
        wanted = 1.02 * (TARGET - now) * (reach - inside[0]) / max(now - inside[1], 1e-9)
        nearest = 0.1 * (reach - inside[0])
        inside = (reach, now)
        reach = min(reach + float(np.clip(wanted, nearest, (FARTHER - 1.0) * reach)), farthest)
    return inside, None


def _held(
    problem: LeastSquaresProblem, start: FloatArray, index: int, value: float, options: Options
) -> Solution | None:
    """The minimum with one parameter held; None if the model cannot be simulated there."""
    low, high, q = problem.low.copy(), problem.high.copy(), start.copy()
    low[index] = high[index] = q[index] = value
    try:
        return minimise(replace(problem, low=low, high=high), q, options)
    except UNSIMULATED:
        return None
