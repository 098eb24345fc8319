"""Bounded Gauss–Newton with Levenberg–Marquardt damping, one batch of lanes per iteration."""

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
_MODEL_ERROR_RATIO = 2.0
#: A fit ends if so many iterations in a row, together, have not lowered the objective by the
#: tolerance: with a promised decrease of at most one standard deviation, and with a larger one,
#: which a rough objective promises again and again.
_STUCK_ITERATIONS, _ROUGH_ITERATIONS = 4, 6
#: Largest relative difference between an actual and a promised decrease that confirms an update.
_AS_PROMISED = 0.5
#: A finite difference over more than so many standard deviations does not approximate the
#: derivative and is repeated with a smaller step, so often at most: the derivatives of rough
#: residuals grow as fast as steps shrink, so that no step is ever fine enough.
_COARSE, _MOST_FINER = 2.0, 3


@dataclass(frozen=True)
class LeastSquaresProblem:
    """Minimise |r(q)|² + (q − mean)ᵀ precision (q − mean) within bounds.

    mean, step, low, high  (p,); `step` is the largest of the finite differences, taken away from a
                           bound
    precision              (p, p) of the prior
    jacobian               cheaper residuals with the same derivatives, from which the Jacobian is
                           computed; None = from `residuals`
    affordable             whether there is time for another iteration; a fit ends if not
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

    tolerance   largest last step, in posterior standard deviations; the remaining error is of
                second order
    least_gain  relative decrease of the objective that an iteration needs where the model's error
                exceeds the noise; a fit ends after two with less, as the model's error is then far
                larger than the remaining gain
    above       an objective, and the number of iterations after which a fit still above it is
                abandoned; its last Jacobian may be an updated one
    updates     most consecutive steps with a Broyden update of the Jacobian instead of finite
                differences, while the objective falls as promised; it pays where one lane costs
                far less than a batch.  The last Jacobian is never an updated one
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
    iterations  points evaluated, the start included
    converged   whether the last step was within the tolerance
    converged_or_idle  whether it was, or the objective no longer decreased
    remaining_step  (p,) to the minimum of the linear model; 0 if the last step was taken
    promised    decrease of the objective by that step, in the linear model
    """

    q: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    free: NDArray[np.bool_]
    objective: float
    iterations: int
    converged: bool
    remaining_step: FloatArray
    promised: float = 0.0
    converged_or_idle: bool = True

    @property
    def unfinished(self) -> FloatArray:
        """(p, p) covariance with the remaining step as one standard deviation."""
        return np.outer(self.remaining_step, self.remaining_step)


class UnsimulatedError(ValueError):
    """A fit begun where its model cannot be simulated.  Scenario: a cable too soft for its load."""


#: Errors of a fit whose model cannot be simulated, or whose equations are singular.
UNSIMULATED = (UnsimulatedError, np.linalg.LinAlgError)


def minimise(
    problem: LeastSquaresProblem,
    start: FloatArray,
    options: Options = Options(),
    jacobian: FloatArray | None = None,
) -> Solution:
    """Minimum near `start`.

    Every iteration simulates a point and its finite differences in one batch; with
    `options.updates` some simulate one lane only.  With `problem.jacobian` only points that lower
    the objective get finite differences.  The last step, smaller than the tolerance, is taken
    without simulation: residuals and derivatives are then those of the linear model.
    jacobian  (rows, p) at `start`, if it is known
    raises  UnsimulatedError: the residuals at `start` are not finite
    source  Madsen, Nielsen & Tingleff 2004, Methods for Non-Linear Least Squares, alg. 3.16, with
            damping relative to the diagonal and 0 at first; bounds by active set
    """
    here = _start(problem, np.clip(start, problem.low, problem.high), jacobian)
    largest, stuck_at = problem.step, here.objective
    damping, growth, iterations, converged, idle, stuck, stalled = 0.0, 2.0, 1, False, 0, 0, False
    while True:
        normal = here.jacobian.T @ here.jacobian + problem.precision
        slope = here.jacobian.T @ here.residual + problem.precision @ (here.q - problem.mean)
        problem = replace(problem, step=within_deviations(largest, _deviations(normal)))
        if (finer := _with_finer_steps(problem, here)) is not here:
            here = finer
            continue
        # Damping hides the distance along a valley, so convergence is judged without it.
        step = full_step = _bounded_step(problem, here.q, normal, slope, 0.0)
        square = float(here.residual @ here.residual)
        scale = max(1.0, square / max(1, int(np.count_nonzero(here.residual))))
        promised = -float(step @ (2.0 * slope + normal @ step))
        near = float(step @ normal @ step) <= options.tolerance**2 * scale
        if stuck_at - here.objective > options.tolerance * scale:
            stuck, stuck_at = 0, here.objective
        stalled = stuck >= (_STUCK_ITERATIONS if promised <= scale else _ROUGH_ITERATIONS)
        if iterations >= options.above[1] and here.objective > options.above[0]:
            break
        last = iterations >= options.max_iterations or not problem.affordable()
        if near or stalled or last or (idle == 2 and scale > _MODEL_ERROR_RATIO):
            computed = _with_computed_jacobian(problem, here)
            if computed is not here:
                here = computed
                continue
            converged = near and not here.updates
            if converged:
                here = replace(here, q=here.q + step, residual=here.residual + here.jacobian @ step)
            break
        if damping > 0.0:
            step = _bounded_step(problem, here.q, normal, slope, damping)
        iterations, stuck = iterations + 1, stuck + 1
        if here.updates < options.updates or problem.jacobian is not None:
            there = _broyden_step(problem, here, step, np.diag(normal))
        else:
            there = _linearise(problem, here.q + step)
        if there.objective < here.objective and there.usable:
            fall = here.objective - there.objective
            gain = fall / -float(step @ (2.0 * slope + normal @ step))
            small = fall < options.least_gain * here.objective
            too_often = there.updates > options.updates
            if too_often or (there.updates and (small or abs(gain - 1.0) > _AS_PROMISED)):
                there = _with_computed_jacobian(problem, there)
            if not (small and here.updates):
                idle = idle + 1 if small else 0
            here = there
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            growth = 2.0
        elif here.updates and (computed := _with_computed_jacobian(problem, here)) is not here:
            here = computed
        else:
            damping = max(growth * damping, _FIRST_DAMPING)
            growth *= 2.0
            if damping > _HOPELESS_DAMPING:
                break
    free = (here.q > problem.low) & (here.q < problem.high)
    remaining = (np.zeros_like(full_step), 0.0) if converged else (full_step, promised)
    at_minimum = here.q, here.residual, here.jacobian, _covariance(normal, free), free
    ended = _objective(problem, here.q, here.residual), iterations, converged
    return Solution(*at_minimum, *ended, *remaining, converged or stalled)


@dataclass(frozen=True, eq=False)
class _Point:
    """Residual (rows,) and Jacobian (rows, p) at q (p,); not finite where it cannot be simulated.

    updates  Broyden updates since the Jacobian was computed
    step     (p,) of its differences; None if it is updated or of another problem
    refined  how often the differences were repeated with smaller steps
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
        """Whether residual and Jacobian could be simulated."""
        return bool(np.all(np.isfinite(self.residual)) and np.all(np.isfinite(self.jacobian)))


def _start(problem: LeastSquaresProblem, start: FloatArray, jacobian: FloatArray | None) -> _Point:
    """The start of a fit."""
    if jacobian is None:
        here = _linearise(problem, start)
    else:
        residual = problem.residuals(start[None])[0]
        here = _Point(start, residual, jacobian, _objective(problem, start, residual))
    if not here.usable:
        raise UnsimulatedError("the model cannot be simulated at the start of the fit")
    return here


def _linearise(
    problem: LeastSquaresProblem, q: FloatArray, known: FloatArray | None = None
) -> _Point:
    """The point at q, its Jacobian by finite differences.

    known  residual there, where the derivatives are those of `problem.jacobian`
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


def jacobian_at(problem: LeastSquaresProblem, q: FloatArray, covariance: FloatArray) -> FloatArray:
    """(rows, p) by finite differences at q; not finite where it cannot be simulated.

    covariance  (p, p) of q: no difference reaches further than its standard deviations
    """
    step = within_deviations(problem.step, np.sqrt(np.abs(np.diag(covariance))))
    return _linearise(replace(problem, step=step), q).jacobian


def _with_computed_jacobian(problem: LeastSquaresProblem, point: _Point) -> _Point:
    """The point with a Jacobian by finite differences, unless they cannot be simulated."""
    if not point.updates:
        return point
    computed = _linearise(problem, point.q, point.residual)
    return computed if computed.usable else point


def _with_finer_steps(problem: LeastSquaresProblem, point: _Point) -> _Point:
    """The point with differences over the problem's steps, if its own steps are far larger."""
    if point.step is None or point.refined == _MOST_FINER:
        return point
    if not np.any(point.step > _COARSE * problem.step):
        return point
    finer = _linearise(problem, point.q, point.residual)
    return replace(finer, refined=point.refined + 1) if finer.usable else point


def _broyden_step(
    problem: LeastSquaresProblem, point: _Point, step: FloatArray, weight: FloatArray
) -> _Point:
    """The point after a step, with the least change of the Jacobian, in units of weight^-½.

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
    alike = damped / np.outer(size, size)  # its solution does not depend on units
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
