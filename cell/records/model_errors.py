"""Errors of a line's model: the mean error of all cables, and whether it is worse than before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from scipy import special

from cell.cable.arrays import FloatArray
from cell.records.result import Result

#: Least number of cycles that are evaluated.
FEWEST = 5
#: Largest number of the newest cycles in a mean.
MOST_MEAN = 50
#: A mean is reported if its interval of this confidence lies beyond the arm's repeatability, m.  It
#: is tested after every run.
CONFIDENCE, REPEATABILITY_M = 0.999, 1e-4
#: Largest number of compared cycles per model: the first since the change, the last before.
MOST_COMPARED = 20
#: Level of the one-sided rank test.  Tested after every cycle, a model that is as good as its
#: predecessor is reported as worse in one change of 100 (3 of 400 simulated, of each quantity);
#: of errors five times as large three of four are reported after 10 cables.
SIGNIFICANCE = 0.003
#: Relative differences below this are negligible.
WORSE = 1.2


@dataclass(frozen=True)
class MeanError:
    """Mean height of the tip above its forecast in the opening, m, with its interval.

    cycles  number of cables
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
    known_m = [error_m for r in results if (error_m := r.miss_error_m) is not None]
    errors_m = np.array(known_m[-MOST_MEAN:])
    if len(errors_m) < FEWEST:
        return None
    mean_m, low_m, high_m = interval(errors_m)
    if min(abs(low_m), abs(high_m)) <= REPEATABILITY_M or low_m * high_m < 0.0:
        return None
    return MeanError(mean_m, low_m, high_m, len(errors_m))


@dataclass(frozen=True)
class Worsening:
    """A quantity that is larger since the model was changed.

    what      description
    before_m, since_m             root mean square, m
    cycles_before, cycles_since   compared
    p_value   of ranks, one-sided
    """

    what: str
    before_m: float
    since_m: float
    cycles_before: int
    cycles_since: int
    p_value: float

    def __str__(self) -> str:
        return (
            f"since the model was changed {self.what}: {self.since_m * 1e3:.3f} mm rms in "
            f"{self.cycles_since} cables, before {self.before_m * 1e3:.3f} mm in "
            f"{self.cycles_before} (p = {self.p_value:.1g})"
        )


def worsenings(results: Sequence[Result]) -> list[Worsening]:
    """Errors that are larger in the newest model's first cycles than in the former one's last.

    results  of any model, oldest first; a few give no result
    """
    since, before = _newest_two(results)
    worse = []
    for text, entry in (
        ("forecasts err by more", "miss_error_m"),
        ("the model misses the swing by more", "residual_rms_m"),
    ):
        compared = _compare(
            text, _sizes_m(before, entry)[-MOST_COMPARED:], _sizes_m(since, entry)[:MOST_COMPARED]
        )
        if compared is not None:
            worse.append(compared)
    return worse


def newest_models(results: Sequence[Result]) -> tuple[str, str] | None:
    """Hashes of the newest model and of its predecessor; None = there is only one."""
    since, before = _newest_two(results)
    pair = next((r.model for r in since), None), next((r.model for r in before), None)
    return None if pair[0] is None or pair[1] is None else (pair[0], pair[1])


def _newest_two(results: Sequence[Result]) -> tuple[list[Result], list[Result]]:
    """Results of the newest model, and of its predecessor, each of its last period of use."""
    known = (r for r in results if r.model is not None)
    runs = [list(run) for _, run in groupby(known, key=lambda r: r.model)]
    if len(runs) < 2:
        return [], []
    return runs[-1], runs[-2]


def _sizes_m(results: Sequence[Result], entry: str) -> FloatArray:
    return np.array([abs(v) for r in results if (v := getattr(r, entry)) is not None])


def _compare(text: str, before: FloatArray, since: FloatArray) -> Worsening | None:
    if min(len(before), len(since)) < FEWEST:
        return None
    before_m, since_m = (float(np.sqrt(np.mean(v**2))) for v in (before, since))
    if since_m <= WORSE * before_m:
        return None
    from scipy.stats import mannwhitneyu  # half a second, of which only few have need

    p_value = float(mannwhitneyu(since, before, alternative="greater").pvalue)
    if p_value > SIGNIFICANCE:
        return None
    return Worsening(text, before_m, since_m, len(before), len(since), p_value)
