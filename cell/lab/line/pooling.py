"""One parameter of several studies: mean, spread between them, and who disagrees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit as t_quantile

from cell.cable.arrays import FloatArray
from cell.lab.fit.shared import Spread


@dataclass(frozen=True, eq=False)
class Pooled:
    """The mean of values with known standard deviations, all in a fit's coordinates.

    reach    half of its 95 % interval
    spread   between the values beyond what each is uncertain by; Cochran's Q and its p-value
    without  (n,) the mean without each of them
    """

    mean: float
    reach: float
    spread: Spread
    without: FloatArray


def pool(values: FloatArray, std: FloatArray) -> Pooled:
    """Random-effects mean of (n,) values.

    source  variance between them by restricted maximum likelihood, see `Spread`; interval:
            Knapp & Hartung 2003, Statistics in Medicine 22, 2693, never narrower than by the
            standard deviations alone
    """
    spread = Spread.of(values, std)
    weights = 1.0 / (std**2 + spread.tau**2)
    mean = float(np.average(values, weights=weights))
    by_std = 1.0 / float(weights.sum())
    n = len(values)
    reach = 1.959964 * np.sqrt(by_std)
    if n > 1:
        seen = float(np.sum(weights * (values - mean) ** 2)) / (n - 1)
        knapp = float(t_quantile(n - 1, 0.975)) * np.sqrt(by_std * seen)
        reach = max(reach, knapp)
    others = [
        float(np.average(np.delete(values, i), weights=np.delete(weights, i))) if n > 1 else mean
        for i in range(n)
    ]
    return Pooled(mean, float(reach), spread, np.array(others))
