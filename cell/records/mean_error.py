"""The error that the forecasts of all cables of a line have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from cell.cable.arrays import FloatArray
from cell.records.result import Result

#: Cycles that are looked at: at least, and at most the newest.
FEWEST, MOST = 5, 50
#: A mean is told if its interval of this confidence lies beyond what an arm repeats to, m.  It is
#: looked at after every run.
CONFIDENCE, REPEATABILITY_M = 0.999, 1e-4


@dataclass(frozen=True)
class MeanError:
    """Mean height of the tip above its forecast in the opening, m, with its interval.

    cycles  so many cables
    """

    mean_m: float
    low_m: float
    high_m: float
    cycles: int

    def __str__(self) -> str:
        low_m, high_m = sorted((abs(self.low_m), abs(self.high_m)))
        where = "above" if self.mean_m > 0.0 else "below"
        return (
            f"tips pass the opening {abs(self.mean_m) * 1e3:.2f} mm {where} their forecast in the "
            f"mean of {self.cycles} cables ({CONFIDENCE:.1%} interval {low_m * 1e3:.2f} to "
            f"{high_m * 1e3:.2f} mm): the model lacks something that all of them have"
        )


def interval(errors_m: FloatArray, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """Mean of (n ≥ 2,) errors and both ends of its confidence interval, m.

    source  Student 1908, The probable error of a mean, Biometrika 6, 1
    """
    n, mean_m = len(errors_m), float(errors_m.mean())
    quantile = float(special.stdtrit(n - 1, 0.5 + 0.5 * confidence))
    half_m = quantile * float(errors_m.std(ddof=1)) / np.sqrt(n)
    return mean_m, mean_m - half_m, mean_m + half_m


def mean_error(results: Sequence[Result]) -> MeanError | None:
    """Mean error of the newest forecasts; None = too few, or it may be negligible.

    results  of one model, oldest first
    """
    errors_m = np.array(
        [
            r.measured_miss_m - r.predicted_miss_m
            for r in results
            if r.measured_miss_m is not None and r.predicted_miss_m is not None
        ][-MOST:]
    )
    if len(errors_m) < FEWEST:
        return None
    mean_m, low_m, high_m = interval(errors_m)
    if min(abs(low_m), abs(high_m)) <= REPEATABILITY_M or low_m * high_m < 0.0:
        return None
    return MeanError(mean_m, low_m, high_m, len(errors_m))
