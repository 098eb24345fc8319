"""Bounded Gauss–Newton with Levenberg–Marquardt damping, one batch of lanes per pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from cell.identify.differences import difference_points, one_sided_steps

FloatArray = NDArray[np.float64]

#: Residuals of many parameter vectors at once: (lanes, p) → (lanes, rows), white, of unit size.
#: A lane that cannot be computed is not finite throughout.
Residuals = Callable[[FloatArray], FloatArray]

_FIRST_DAMPING = 1e-2
_HOPELESS_DAMPING = 1e8
#: Mean square of white residuals from which a model errs by more than the noise.
_ERRS = 2.0


@dataclass(frozen=True)
class Problem:
    """Minimise |r(q)|² + (q − mean)ᵀ precision (q − mean) within bounds.

    mean, step, low, high  (p,); `step` is that of the finite differences, taken away from a bound
    precision              (p, p) of the prior
    """

    residuals: Residuals
    mean: FloatArray
    precision: FloatArray
    step: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Options:
    """Criteria for ending a minimisation.

    tolerance   largest last step, in posterior standard deviations; what is left after it is of
                second order
    least_gain  share of the objective by which passes must lower it where the model errs by more
                than the noise; after two that do not, what more of them would find is far below
                what the answer could be wrong by
    """

    tolerance: float = 0.1
    most_passes: int = 25
    least_gain: float = 0.0


@dataclass(frozen=True)
class Solution:
    """The minimum, with the linear model and the covariance there.

    q           (p,) at the minimum
    residual    (rows,) white residuals there
    jacobian    (rows, p) their derivatives there
    covariance  (p, p) of q if the residuals are white noise of unit size
    free        (p,) whether a parameter is inside its bounds
    objective   |r|² plus the prior's term
    passes      batches simulated
    converged   whether the last step was within the tolerance
    """

    q: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    free: NDArray[np.bool_]
    objective: float
    passes: int
    converged: bool


def minimise(problem: Problem, start: FloatArray, options: Options = Options()) -> Solution:
    """Minimum near `start`.

    Every pass simulates a point and its finite differences together, so that an accepted step
    costs one pass.  The last step, smaller than the tolerance, is taken without another pass:
    residuals and derivatives are then those of the linear model.
    raises  ValueError: the residuals at `start` are not finite
    source  Madsen, Nielsen & Tingleff 2004, Methods for Non-Linear Least Squares, alg. 3.16, with
            damping relative to the diagonal and 0 at first; bounds by active set
    """
    q = np.clip(start, problem.low, problem.high)
    residual, jacobian = _linearise(problem, q)
    if not (np.all(np.isfinite(residual)) and np.all(np.isfinite(jacobian))):
        raise ValueError("the model cannot be simulated at the start of the fit")
    objective = _objective(problem, q, residual)
    damping, growth, passes, converged, idle = 0.0, 2.0, 1, False, 0
    while True:
        normal = jacobian.T @ jacobian + problem.precision
        slope = jacobian.T @ residual + problem.precision @ (q - problem.mean)
        # Damping hides how far it still is along a valley, so nearness is judged without it.
        step = _bounded_step(problem, q, normal, slope, 0.0)
        rows = int(np.count_nonzero(residual))
        scale = max(1.0, float(residual @ residual) / max(1, rows))
        if float(step @ normal @ step) <= options.tolerance**2 * scale:
            q, residual, converged = q + step, residual + jacobian @ step, True
            break
        if passes >= options.most_passes or (idle == 2 and scale > _ERRS):
            break
        passes += 1
        if damping > 0.0:
            step = _bounded_step(problem, q, normal, slope, damping)
        trial = q + step
        trial_residual, trial_jacobian = _linearise(problem, trial)
        trial_objective = _objective(problem, trial, trial_residual)
        if trial_objective < objective and np.all(np.isfinite(trial_jacobian)):
            promised = -float(step @ (2.0 * slope + normal @ step))
            gain = (objective - trial_objective) / promised
            small = objective - trial_objective < options.least_gain * objective
            idle = idle + 1 if small else 0
            q, residual, jacobian, objective = (
                trial,
                trial_residual,
                trial_jacobian,
                trial_objective,
            )
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            growth = 2.0
        else:
            damping = max(growth * damping, _FIRST_DAMPING)
            growth *= 2.0
            if damping > _HOPELESS_DAMPING:
                break
    free = (q > problem.low) & (q < problem.high)
    return Solution(
        q,
        residual,
        jacobian,
        _covariance(normal, free),
        free,
        _objective(problem, q, residual),
        passes,
        converged,
    )


def _linearise(problem: Problem, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residual (rows,) and Jacobian (rows, p) at q; not finite where it cannot be simulated."""
    step = one_sided_steps(q, problem.step, problem.high)
    lanes = problem.residuals(difference_points(q, step))
    if not np.all(np.isfinite(lanes)):
        return lanes[0], np.full((lanes.shape[1], len(q)), np.nan)
    return lanes[0], (lanes[1:] - lanes[0]).T / step


def _objective(problem: Problem, q: FloatArray, residual: FloatArray) -> float:
    away = q - problem.mean
    value = float(residual @ residual + away @ problem.precision @ away)
    return value if np.isfinite(value) else np.inf


def _bounded_step(
    problem: Problem, q: FloatArray, normal: FloatArray, slope: FloatArray, damping: float
) -> FloatArray:
    """Damped step; parameters that it would drive out of bounds go to the bound and stay there."""
    damped = normal + damping * np.diag(np.diag(normal))
    step = np.zeros_like(q)
    free = np.ones(len(q), dtype=bool)
    for _ in range(len(q) + 1):
        if not free.any():
            break
        inside = np.ix_(free, free)
        right = -(slope[free] + damped[np.ix_(free, ~free)] @ step[~free])
        step[free] = cho_solve(cho_factor(damped[inside]), right)
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
