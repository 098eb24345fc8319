"""Least squares that is robust to a few outliers, with the covariance of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.errors import OneSidedError
from drivers.interfaces import FloatArray

#: (P,) parameters → (N, 2) residuals, px, and their (N, 2, P) derivatives.
Model = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, eq=False)
class PriorKnowledge:
    """Gaussian prior of the parameters, to be combined with the information from the points.

    expected     (P,) parameters, with (P, P) information (inverse covariance) about them
    further      (P,) → (K,) residuals in standard deviations, and their (K, P) derivatives
    """

    expected: FloatArray
    information: FloatArray
    further: Callable[[FloatArray], tuple[FloatArray, FloatArray]] | None = None

    @classmethod
    def with_spread(cls, expected: FloatArray, spread: FloatArray) -> PriorKnowledge:
        """Parameters known to (P,) standard deviations, inf = not at all."""
        return cls(expected, np.diag(np.where(np.isfinite(spread), 1.0 / spread**2, 0.0)))

    def cost(self, x: FloatArray) -> float:
        """Twice the negative logarithm of its probability, up to a constant."""
        off = x - self.expected
        cost = float(off @ self.information @ off)
        return cost if self.further is None else cost + float(np.sum(self.further(x)[0] ** 2))

    def normal_equations(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(P, P) matrix and (P,) slope of half that cost."""
        matrix, slope = self.information, self.information @ (x - self.expected)
        if self.further is not None:
            residual, jacobian = self.further(x)
            matrix, slope = matrix + jacobian.T @ jacobian, slope + jacobian.T @ residual
        return matrix, slope


#: Distance of an outlier, in standard deviations of the noise.
OUTLIER_SIGMAS = 5.0
_LEAST_PX = 1e-4  # a fit of exact points still has a scale
_ITERATIONS = 4
_MOST_STEPS = 60
_SMALLEST_GAIN = 1e-9  # of the cost: less is far below any standard deviation


@dataclass(frozen=True, eq=False)
class RobustFit:
    """The result of a robust least-squares fit.

    mean        (P,) parameters
    covariance  (P, P) from the points' own scatter and the priors
    noise_px    standard deviation of one coordinate of a point
    residuals   (N, 2) of all points, outliers too, px
    used        (N,) False = an outlier, which is not in the last fit
    """

    mean: FloatArray
    covariance: FloatArray
    noise_px: float
    residuals: FloatArray
    used: NDArray[np.bool_]


def robust_fit(model: Model, start: FloatArray, prior: PriorKnowledge) -> RobustFit:
    """Parameters that fit the points best, without outliers.

    A fit with a loss that grows linearly gives the scale of the noise; points beyond
    `OUTLIER_SIGMAS` of it are omitted, and the others are fitted by plain least squares.

    start   (P,) first guess
    raises  OneSidedError: the points leave a direction of the parameters open
    """
    x, count = start, len(model(start)[0])
    used = np.ones(count, dtype=np.bool_)
    noise = max(_scale(model(x)[0]), _LEAST_PX)
    for iteration in range(_ITERATIONS):
        x = _least_squares(model, x, used / noise, prior, robust=iteration == 0)
        residuals = model(x)[0]
        noise_before, used_before = noise, used
        freedom = max(
            1.0,
            2.0 * np.count_nonzero(used) - len(x) + np.count_nonzero(np.diag(prior.information)),
        )
        if iteration == 0:
            noise = max(_scale(residuals), _LEAST_PX)
        else:
            noise = max(float(np.sqrt(np.sum(residuals[used] ** 2) / freedom)), _LEAST_PX)
        used = np.linalg.norm(residuals, axis=1) < OUTLIER_SIGMAS * noise
        converged = abs(noise / noise_before - 1.0) < 1e-3 and np.array_equal(used, used_before)
        if iteration > 1 and converged:
            break
    slopes = model(x)[1][used].reshape(-1, len(x)) / noise
    information = slopes.T @ slopes + prior.normal_equations(x)[0]
    return RobustFit(x, _covariance(information), noise, residuals, used)


def sum_variance(terms: FloatArray) -> float:
    """Variance of the sum of (N,) terms of mean 0 whose neighbours may be correlated.

    source  Newey & West 1987
    """
    lags = max(1, round(len(terms) ** (1 / 3)) * 2)
    total = float(terms @ terms)
    for k in range(1, min(lags + 1, len(terms))):
        total += 2.0 * (1.0 - k / (lags + 1)) * float(terms[k:] @ terms[:-k])
    return total


def _least_squares(
    model: Model,
    start: FloatArray,
    scale: FloatArray,
    prior: PriorKnowledge,
    *,
    robust: bool,
) -> FloatArray:
    """Parameters of the least cost, by Levenberg's damped steps on scaled normal equations.

    scale   (N,) factors on the points' residuals: 0 = omitted
    robust  cost 2(√(1 + d²) − 1) of a point at distance d instead of d²
    """

    def cost_of(x: FloatArray, residuals: FloatArray) -> tuple[float, FloatArray]:
        squares = scale**2 * np.sum(residuals**2, axis=1)
        if not robust:
            return float(np.sum(squares)) + prior.cost(x), scale**2
        roots = np.sqrt(1.0 + squares)
        return float(np.sum(2.0 * (roots - 1.0))) + prior.cost(x), scale**2 / roots

    x, damping = start, 1e-4
    residuals, slopes = model(x)
    cost, weights = cost_of(x, residuals)
    for _ in range(_MOST_STEPS):
        flat = slopes.reshape(-1, len(x))
        weighted = flat * np.repeat(weights, 2)[:, None]
        matrix, slope = prior.normal_equations(x)
        matrix = weighted.T @ flat + matrix
        slope = weighted.T @ residuals.ravel() + slope
        size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        scaled = matrix / np.outer(size, size)
        while damping < 1e8:
            step = np.linalg.solve(scaled + damping * np.eye(len(x)), -slope / size) / size
            if -float(slope @ step) < _SMALLEST_GAIN * max(cost, 1.0):
                return x
            trial = model(x + step)
            trial_cost, trial_weights = cost_of(x + step, trial[0])
            if np.isfinite(trial_cost) and trial_cost <= cost:
                break
            damping *= 10.0
        else:
            return x
        gain = cost - trial_cost
        x, (residuals, slopes), cost, weights = x + step, trial, trial_cost, trial_weights
        damping = max(damping / 10.0, 1e-12)
        if gain < _SMALLEST_GAIN * max(cost, 1.0):
            return x
    return x


def _scale(residuals: FloatArray) -> float:
    """Standard deviation of a coordinate, from the median absolute residual."""
    return float(1.4826 * np.median(np.abs(residuals)))


def _covariance(information: FloatArray) -> FloatArray:
    """Inverse, scaled first.  Raises OneSidedError: singular."""
    size = np.sqrt(np.diag(information))
    if np.any(size == 0.0):
        raise OneSidedError("a parameter has no influence on any point", "add other views")
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    if values[0] < 1e-13 * values[-1]:
        raise OneSidedError(
            "the views leave the result open", "add views from other sides, tilted and turned"
        )
    root = vectors / np.sqrt(values) / size[:, None]
    return np.asarray(root @ root.T, dtype=np.float64)
