"""One-sided finite differences that stay within the parameters' bounds."""

from __future__ import annotations

import numpy as np

from cell.cable.arrays import FloatArray


def one_sided_steps(q: FloatArray, step: FloatArray, high: FloatArray) -> FloatArray:
    """(p,) steps from q, forward unless that would leave the bounds.

    q, step, high  (p,) point, size of the steps > 0, upper bounds
    """
    return np.where(q + step <= high, step, -step)


#: A difference over less than this share of a parameter's usual step is lost in rounding.
FINEST = 1e-4


def within_deviations(step: FloatArray, std: FloatArray) -> FloatArray:
    """(p,) steps that reach no further than the standard deviations (p,), where these are known.

    Over more than the data leave open a difference may be of another sign than the slope: the start
    of a ringing, known to 20 µs, was moved by 5 ms.
    """
    return np.where(std > 0.0, np.clip(std, FINEST * step, step), step)


def difference_points(q: FloatArray, steps: FloatArray) -> FloatArray:
    """(1 + p, p) the point q and its neighbours, each with one parameter moved."""
    return np.vstack([q, q + np.diag(steps)])
