"""One-sided finite differences that stay within the parameters' bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def one_sided_steps(q: FloatArray, step: FloatArray, high: FloatArray) -> FloatArray:
    """(p,) steps from q, forward unless that would leave the bounds.

    q, step, high  (p,) point, size of the steps > 0, upper bounds
    """
    return np.where(q + step <= high, step, -step)


def difference_points(q: FloatArray, steps: FloatArray) -> FloatArray:
    """(1 + p, p) the point q and its neighbours, each with one parameter moved."""
    return np.vstack([q, q + np.diag(steps)])
