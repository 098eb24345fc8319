"""The bending law as a sum of springs: one without a dead band, the others each beyond one.

MuJoCo has no |κ|^(N−1).  It has a hinge's spring a x + c x³, and fixed tendons whose spring
begins beyond a dead band.  Together they are an odd cubic spline that is linear beyond the last
knot, which follows the law as closely as wanted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.model import REFERENCE_CURVATURE_1_PER_M, REGULAR_CURVATURE_1_PER_M

#: Error of the tip at rest that the springs' error in curvature may cause, if it had one sign
#: everywhere, m: a tenth of the 0.1 mm that an export must keep.  In a swing the error of the
#: frequency adds up to several times as much: with a third the tip was 0.09 mm off.
TIP_ERROR_M = 1e-5
#: Most springs of a hinge, and ratios of one dead band to the one before that are tried: enough for
#: exponents from 0.6 to 2 and cables of 1 m.
_MOST, _RATIOS = 16, (1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0)
#: Beyond so many times the range the springs are linear: at the range itself, where an odd spline
#: has no curvature left, they would miss the law.
_LINEAR_FROM = 1.5
#: Curvatures at which law and springs are compared.
_SAMPLES = 500


@dataclass(frozen=True, eq=False)
class Springs:
    """Springs with M/EI = Σ a D(κ) + c D(κ)³, D(κ) = sign κ · max(|κ| − dead band, 0); κ in 1/m.

    dead_band_1_per_m  (k,), the first is 0
    linear             (k,) a, no unit
    cubic_m2           (k,) c, m²
    error_1_per_m      root mean square of the error, as curvature, up to `range_1_per_m`
    """

    dead_band_1_per_m: FloatArray
    linear: FloatArray
    cubic_m2: FloatArray
    error_1_per_m: float
    range_1_per_m: float

    def __call__(self, curvature_1_per_m: FloatArray) -> FloatArray:
        """M/EI at curvatures (…), 1/m."""
        size = np.abs(np.asarray(curvature_1_per_m))[..., None] - self.dead_band_1_per_m
        beyond = np.maximum(size, 0.0)
        moment = beyond @ self.linear + beyond**3 @ self.cubic_m2
        return np.asarray(np.sign(curvature_1_per_m) * moment)


def law(curvature_1_per_m: FloatArray, exponent: float) -> FloatArray:
    """M/EI of the model at curvatures (…), 1/m; see `CableModel`."""
    k = np.asarray(curvature_1_per_m, dtype=np.float64)
    scale = (k**2 + REGULAR_CURVATURE_1_PER_M**2) / REFERENCE_CURVATURE_1_PER_M**2
    return np.asarray(k * scale ** (0.5 * (exponent - 1.0)))


@lru_cache(maxsize=8)  # of one model and each number of links
def springs_for(exponent: float, length_m: float) -> Springs:
    """The fewest springs whose error moves the tip by less than `TIP_ERROR_M`.

    They follow the law up to the curvature of a cable bent to half a circle, and a little beyond
    they are linear.
    """
    reach = math.pi / length_m
    if exponent == 1.0:
        return Springs(np.zeros(1), np.ones(1), np.zeros(1), 0.0, reach)
    allowed = 2.0 * TIP_ERROR_M / length_m**2
    for number in range(3, _MOST + 1):
        tried = [_fitted(exponent, reach, number, ratio) for ratio in _RATIOS]
        best = min(tried, key=lambda s: s.error_1_per_m)
        if best.error_1_per_m <= allowed:
            break
    return best


def _fitted(exponent: float, reach: float, number: int, ratio: float) -> Springs:
    """Least squares in curvature: error of the moment over the secant stiffness there."""
    bands = np.concatenate([[0.0], _LINEAR_FROM * reach / ratio ** np.arange(number - 2, -1, -1.0)])
    k = np.linspace(0.0, reach, _SAMPLES + 1)[1:]
    moment = law(k, exponent)
    beyond = np.maximum(k[:, None] - bands, 0.0)
    terms = np.hstack([beyond, beyond**3 / reach**2])
    # beyond the last dead band the cubic and the quadratic terms of all springs cancel
    cancel = np.zeros((2, 2 * number))
    cancel[0, number:], cancel[1, number:] = 1.0, bands / reach
    free = np.linalg.qr(cancel.T, mode="complete")[0][:, 2:]
    weight = k / moment
    solved = np.linalg.lstsq((terms @ free) * weight[:, None], moment * weight, rcond=None)[0]
    coefficients = free @ solved
    error = float(np.sqrt(np.mean(((terms @ coefficients - moment) * weight) ** 2)))
    return Springs(bands, coefficients[:number], coefficients[number:] / reach**2, error, reach)
