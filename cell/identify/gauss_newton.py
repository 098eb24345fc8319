"""Bounded Gauss–Newton with Levenberg–Marquardt damping, one batch of lanes per pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.identify.parameters import difference_points, one_sided_steps, within_deviations

#: Residuals of many parameter vectors at once: (lanes, p) → (lanes, rows), white, of unit size.
#: A lane that cannot be computed is not finite throughout.
Residuals = Callable[[FloatArray], FloatArray]

_FIRST_DAMPING = 1e-2
_HOPELESS_DAMPING = 1e8
#: Mean square of white residuals from which a model errs by more than the noise.
_ERRS = 2.0
#: A fit is as good as it gets if so many passes in a row, together, have not lowered the objective
#: by the tolerance: where one standard deviation is all that is promised, and where more is, as by
#: a rough objective again and again.
_STUCK_PASSES, _ROUGH_PASSES = 4, 6
#: A step is as promised if the objective fell by the promise, give or take this share of it.
_AS_PROMISED = 0.5
#: A finite difference must not reach beyond what the data leave open, or it is no slope there: one
#: over more than so many standard deviations is taken again, so often at most: where residuals are
#: rough, slopes grow as fast as steps shrink, and none is ever fine enough.
_COARSE, _MOST_FINER = 2.0, 3


@dataclass(frozen=True)
class LeastSquaresProblem:
    """Minimise |r(q)|² + (q − mean)ᵀ precision (q − mean) within bounds.

    mean, step, low, high  (p,); `step` is the largest of the finite differences, taken away from a
                           bound
    precision              (p, p) of the prior
    jacobian               residuals that cost less and whose differences are as good, if there are
                           any: the Jacobian is theirs
    affordable             whether there is time for another pass; a fit ends where it is if not
    """

    residuals: Residuals
    mean: FloatArray
    precision: FloatArray
    step: FloatArray
    low: FloatArray
    high: FloatArray
    jacobian: Residuals | None = None
    affordable: Callable[[], bool] = lambda: True


@dataclass(frozen=True)
class Options:
    """Criteria for ending a minimisation.

    tolerance   largest last step, in posterior standard deviations; what is left after it is of
                second order
    least_gain  share of the objective by which passes must lower it where the model errs by more
                than the noise; after two that do not, what more of them would find is far below
                what the answer could be wrong by
    above       an objective, and after how many passes a fit is given up that is still above it;
                its last Jacobian may be an updated one
    updates     steps in a row, at most, after which the Jacobian is only updated by the residuals
                that they led to, where these were as promised; it pays where one lane costs far
                less than a batch.  The last Jacobian is never an updated one
    """

    tolerance: float = 0.1
    max_iterations: int = 25
    least_gain: float = 0.0
    updates: int = 0
    above: tuple[float, int] = (np.inf, 0)


@dataclass(frozen=True)
class Solution:
    """The minimum, with the linear model and the covariance there.

    q           (p,) at the minimum
    residual    (rows,) white residuals there
    jacobian    (rows, p) their derivatives there
    covariance  (p, p) of q if the residuals are white noise of unit size
    free        (p,) whether a parameter is inside its bounds
    objective   |r|² plus the prior's term
    iterations  places tried, the start included
    converged   whether the last step was within the tolerance
    converged_or_idle  whether it was, or nothing more was gained
    to_go       (p,) the step to the minimum if the model were linear; 0 if the last one was taken
    promised    by which the objective would fall on that step
    """

    q: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    free: NDArray[np.bool_]
    objective: float
    iterations: int
    converged: bool
    to_go: FloatArray
    promised: float = 0.0
    converged_or_idle: bool = True

    @property
    def unfinished(self) -> FloatArray:
        """(p, p) covariance by the step that was not taken, as one standard deviation."""
        return np.outer(self.to_go, self.to_go)


class UnsimulatedError(ValueError):
    """A fit begun where its model cannot be simulated.  Scenario: a cable too soft for its load."""


#: What a fit ends with whose model cannot be simulated, or leaves nothing to be solved for.
UNSIMULATED = (UnsimulatedError, np.linalg.LinAlgError)


def minimise(
    problem: LeastSquaresProblem,
    start: FloatArray,
    options: Options = Options(),
    jacobian: FloatArray | None = None,
) -> Solution:
    """Minimum near `start`.

    Every pass simulates a point and its finite differences together, so that an accepted step
    costs one pass; with `options.updates` some cost one lane.  Where `problem.jacobian` is known
    only points that lie lower get their finite differences.  The last step, smaller than the
    tolerance, is taken without another pass: residuals and derivatives are then those of the
    linear model.
    jacobian  (rows, p) there, if it is known
    raises  UnsimulatedError: the residuals at `start` are not finite
    source  Madsen, Nielsen & Tingleff 2004, Methods for Non-Linear Least Squares, alg. 3.16, with
            damping relative to the diagonal and 0 at first; bounds by active set
    """
    here = _begun(problem, np.clip(start, problem.low, problem.high), jacobian)
    largest, stuck_at = problem.step, here.objective
    damping, growth, passes, converged, idle, stuck, settled = 0.0, 2.0, 1, False, 0, 0, False
    while True:
        normal = here.jacobian.T @ here.jacobian + problem.precision
        slope = here.jacobian.T @ here.residual + problem.precision @ (here.q - problem.mean)
        problem = replace(problem, step=within_deviations(largest, _deviations(normal)))
        if (finer := _finer(problem, here)) is not here:
            here = finer
            continue
        # Damping hides how far it still is along a valley, so nearness is judged without it.
        step = to_go = _bounded_step(problem, here.q, normal, slope, 0.0)
        square = float(here.residual @ here.residual)
        scale = max(1.0, square / max(1, int(np.count_nonzero(here.residual))))
        promised = -float(step @ (2.0 * slope + normal @ step))
        near = float(step @ normal @ step) <= options.tolerance**2 * scale
        if stuck_at - here.objective > options.tolerance * scale:
            stuck, stuck_at = 0, here.objective
        settled = stuck >= (_STUCK_PASSES if promised <= scale else _ROUGH_PASSES)
        if passes >= options.above[1] and here.objective > options.above[0]:
            break
        last = passes >= options.max_iterations or not problem.affordable()
        if near or settled or last or (idle == 2 and scale > _ERRS):
            computed = _computed(problem, here)
            if computed is not here:
                here = computed
                continue
            converged = near and not here.updates
            if converged:
                here = replace(here, q=here.q + step, residual=here.residual + here.jacobian @ step)
            break
        if damping > 0.0:
            step = _bounded_step(problem, here.q, normal, slope, damping)
        passes, stuck = passes + 1, stuck + 1
        if here.updates < options.updates or problem.jacobian is not None:
            there = _updated(problem, here, step, np.diag(normal))
        else:
            there = _linearise(problem, here.q + step)
        if there.objective < here.objective and there.usable:
            fall = here.objective - there.objective
            gain = fall / -float(step @ (2.0 * slope + normal @ step))
            small = fall < options.least_gain * here.objective
            too_often = there.updates > options.updates
            if too_often or (there.updates and (small or abs(gain - 1.0) > _AS_PROMISED)):
                there = _computed(problem, there)
            if not (small and here.updates):
                idle = idle + 1 if small else 0
            here = there
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            growth = 2.0
        elif here.updates and (computed := _computed(problem, here)) is not here:
            here = computed
        else:
            damping = max(growth * damping, _FIRST_DAMPING)
            growth *= 2.0
            if damping > _HOPELESS_DAMPING:
                break
    free = (here.q > problem.low) & (here.q < problem.high)
    left = (np.zeros_like(to_go), 0.0) if converged else (to_go, promised)
    at_minimum = here.q, here.residual, here.jacobian, _covariance(normal, free), free
    ended = _objective(problem, here.q, here.residual), passes, converged
    return Solution(*at_minimum, *ended, *left, converged or settled)


@dataclass(frozen=True, eq=False)
class _Point:
    """Residual (rows,) and Jacobian (rows, p) at q (p,); not finite where it cannot be simulated.

    updates  since the Jacobian was computed
    step     (p,) of its differences; none if it is updated or of another problem
    refined  so often these were taken again because they were too large
    """

    q: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    objective: float
    updates: int = 0
    step: FloatArray | None = None
    refined: int = 0

    @property
    def usable(self) -> bool:
        """Whether all of it could be simulated."""
        return bool(np.all(np.isfinite(self.residual)) and np.all(np.isfinite(self.jacobian)))


def _begun(problem: LeastSquaresProblem, start: FloatArray, jacobian: FloatArray | None) -> _Point:
    """The start of a fit."""
    here = _linearise(problem, start) if jacobian is None else _seen(problem, start, jacobian)
    if not here.usable:
        raise UnsimulatedError("the model cannot be simulated at the start of the fit")
    return here


def _linearise(
    problem: LeastSquaresProblem, q: FloatArray, known: FloatArray | None = None
) -> _Point:
    """The point at q, its Jacobian by finite differences.

    known  residual there, where the slopes come from elsewhere
    """
    step = one_sided_steps(q, problem.step, problem.high)
    if problem.jacobian is None:
        lanes = problem.residuals(difference_points(q, step))
        residual = lanes[0]
    else:
        residual = problem.residuals(q[None])[0] if known is None else known
        lanes = problem.jacobian(difference_points(q, step))
        if not np.all(np.isfinite(lanes)) and np.all(np.isfinite(residual)):
            lanes = problem.residuals(difference_points(q, step))
    jacobian = np.full((len(residual), len(q)), np.nan)
    if np.all(np.isfinite(lanes)):
        jacobian = (lanes[1:] - lanes[0]).T / step
    return _Point(q, residual, jacobian, _objective(problem, q, residual), step=problem.step)


def _seen(problem: LeastSquaresProblem, q: FloatArray, jacobian: FloatArray) -> _Point:
    """The point at q, its Jacobian known."""
    residual = problem.residuals(q[None])[0]
    return _Point(q, residual, jacobian, _objective(problem, q, residual))


def jacobian_at(problem: LeastSquaresProblem, q: FloatArray, covariance: FloatArray) -> FloatArray:
    """(rows, p) by finite differences at q; not finite where it cannot be simulated.

    covariance  (p, p) of q: no difference reaches further than its standard deviations
    """
    step = within_deviations(problem.step, np.sqrt(np.abs(np.diag(covariance))))
    return _linearise(replace(problem, step=step), q).jacobian


def _computed(problem: LeastSquaresProblem, point: _Point) -> _Point:
    """The point with a Jacobian that is not updated, unless none can be computed there."""
    if not point.updates:
        return point
    computed = _linearise(problem, point.q, point.residual)
    return computed if computed.usable else point


def _finer(problem: LeastSquaresProblem, point: _Point) -> _Point:
    """The point with slopes over the problem's steps, if its own are over far larger ones."""
    if point.step is None or point.refined == _MOST_FINER:
        return point
    if not np.any(point.step > _COARSE * problem.step):
        return point
    finer = _linearise(problem, point.q, point.residual)
    return replace(finer, refined=point.refined + 1) if finer.usable else point


def _updated(
    problem: LeastSquaresProblem, point: _Point, step: FloatArray, weight: FloatArray
) -> _Point:
    """The point a step on: the least change of the Jacobian, in units of weight^-½, explains it.

    source  Broyden, Math. Comp. 19 (1965) 577, "good" method
    """
    q = point.q + step
    residual = problem.residuals(q[None])[0]
    beyond = residual - point.residual - point.jacobian @ step
    jacobian = point.jacobian + np.outer(beyond, weight * step / (step @ (weight * step)))
    return _Point(q, residual, jacobian, _objective(problem, q, residual), point.updates + 1)


def _objective(problem: LeastSquaresProblem, q: FloatArray, residual: FloatArray) -> float:
    away = q - problem.mean
    value = float(residual @ residual + away @ problem.precision @ away)
    return value if np.isfinite(value) else np.inf


def _deviations(normal: FloatArray) -> FloatArray:
    """(p,) standard deviations of parameters, by the curvature; 0 where there is none."""
    size = np.sqrt(np.diag(normal))
    unit = np.where(size > 0.0, size, 1.0)
    try:
        variance = np.diag(np.linalg.inv(normal / np.outer(unit, unit)))
    except np.linalg.LinAlgError:
        return np.zeros_like(size)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)) / unit)


def _bounded_step(
    problem: LeastSquaresProblem,
    q: FloatArray,
    normal: FloatArray,
    slope: FloatArray,
    damping: float,
) -> FloatArray:
    """Damped step; parameters that it would drive out of bounds go to the bound and stay there."""
    damped = normal + damping * np.diag(np.diag(normal))
    size = np.sqrt(np.diag(damped))
    alike = damped / np.outer(size, size)  # of which the solution does not hang on units
    step = np.zeros_like(q)
    free = np.ones(len(q), dtype=bool)
    for _ in range(len(q) + 1):
        if not free.any():
            break
        inside = np.ix_(free, free)
        right = -(slope[free] + damped[np.ix_(free, ~free)] @ step[~free])
        step[free] = np.linalg.solve(alike[inside], right / size[free]) / size[free]
        below, above = q + step < problem.low, q + step > problem.high
        out = free & (below | above)
        if not out.any():
            break
        step[out] = np.where(below, problem.low - q, problem.high - q)[out]
        free &= ~out
    return step


def _covariance(normal: FloatArray, free: NDArray[np.bool_]) -> FloatArray:
    """Inverse of the curvature; parameters at a bound keep their own variance, uncorrelated."""
    covariance = np.diag(1.0 / np.diag(normal))
    if free.any():
        inside = np.ix_(free, free)
        covariance[inside] = np.linalg.inv(normal[inside])
    return covariance
