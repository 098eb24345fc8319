"""Squares of correlated normal values, which are distributed nearly as a scaled χ²."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri as chi2_quantile
from scipy.special import fdtri as f_quantile

from cell.cable.arrays import FloatArray


@dataclass(frozen=True)
class ExpectedSquare:
    """Of a sum of squares under noise alone: its mean, and how well that is known.

    mean       of the sum
    dof        of the χ² that has, scaled, the same mean and variance: the number of values if all
               are independent and equal, fewer if errors common to many of them are larger
    dof_mean   degrees of freedom behind the mean
    source     Satterthwaite 1946, Biometrics Bulletin 2, 110
    """

    mean: float
    dof: float
    dof_mean: float

    @staticmethod
    def of(
        noise: FloatArray, level: float, dof_level: float, errors: FloatArray, draws: int
    ) -> ExpectedSquare:
        """Of values that noise and some errors shift.

        noise      (n, n) covariance by noise of level 1
        level      mean square of the noise, known by so many degrees of freedom
        errors     (n, k) changes by errors: each column a standard deviation in its direction
        draws      number of draws that the errors' covariance is known by
        """
        shared = 2.0 * level * float(np.sum((noise @ errors) * errors))
        square = level**2 * float(np.sum(noise**2)) + shared
        of_noise = level * float(np.trace(noise))
        return _of_traces(of_noise, dof_level, square, errors.T @ errors, draws)

    @staticmethod
    def of_white(
        count: float, level: float, dof_level: float, products: FloatArray, draws: int
    ) -> ExpectedSquare:
        """The same of so many independent values; (k, k) products of the errors' changes."""
        square = level**2 * count + 2.0 * level * float(np.trace(products))
        return _of_traces(level * count, dof_level, square, products, draws)

    def exceeded_with(self, p: float) -> float:
        """The sum of squares that is exceeded with this probability."""
        if np.isfinite(self.dof_mean):
            return self.mean * float(f_quantile(self.dof, self.dof_mean, 1.0 - p))
        return self.mean * float(chi2_quantile(self.dof, p)) / self.dof


def _of_traces(
    of_noise: float, dof_level: float, square: float, products: FloatArray, draws: int
) -> ExpectedSquare:
    """By what noise adds to tr C, and noise and its products with the errors to tr C²."""
    of_errors = float(np.sum(products**2))
    mean = of_noise + float(np.trace(products))
    uncertain = of_noise**2 / dof_level + of_errors / draws
    return ExpectedSquare(
        mean,
        mean**2 / max(square + of_errors, 1e-300),
        mean**2 / uncertain if uncertain > 0.0 else np.inf,
    )
