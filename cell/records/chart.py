"""Control charts over a line's cycles: whether forecasts or fits have become worse, and since when.

Two quantities, each on an individuals' chart for a sudden change and on an EWMA chart for a slow
one: the error of the tip's height in the mouth over what the forecast expects of it, and the
logarithm of what the model misses while the cable swings, over the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from cell.records.result import Result

FloatArray = NDArray[np.float64]

#: All charts together give at most one false alarm in so many cycles.
FALSE_ALARM_CYCLES = 1000.0
CHARTS = 4
#: Weight of the newest value in the moving average.
WEIGHT = 0.2
#: Cycles that must have been before a cycle is judged by them.
FEWEST_BEFORE = 8
#: Added, in square, to the scatter that cables show, because a few are odd without any effect (5
#: of 700 simulated ones gave an alarm): of the forecast's error over what it expects, and of what
#: a model misses over the noise (logarithm).
LEAST_FORECAST, LEAST_MISSED = 0.25, 0.05


@dataclass(frozen=True)
class Signal:
    """A quantity that has left its limits.

    what      in words
    since     folder of the first cycle of the change
    at        folder of the cycle at which it was noticed
    cycles    so many cycles since then
    before_m, after_m   its mean size before and since, m
    """

    what: str
    since: str
    at: str
    cycles: int
    before_m: float
    after_m: float

    def __str__(self) -> str:
        return (
            f"{self.what} since {self.since}, for {self.cycles} cables: "
            f"{self.after_m * 1e3:.3f} mm rms, before {self.before_m * 1e3:.3f} mm"
        )


def signals(results: Sequence[Result]) -> list[Signal]:
    """What has changed in the cycles of one model, oldest first; nothing is said of a few."""
    found = []
    executed = [
        (r.folder, (r.measured_miss_m - r.predicted_miss_m), r.predicted_std_m)
        for r in results
        if r.measured_miss_m is not None and r.predicted_miss_m is not None and r.predicted_std_m
    ]
    errors = np.array([e for _, e, _ in executed])
    standard = np.array([e / s for _, e, s in executed])
    if (change := _change(standard, LEAST_FORECAST)) is not None:
        found.append(
            _signal("forecasts err by more", [c for c, _, _ in executed], np.abs(errors), change)
        )
    swung = [
        (r.folder, r.residual_rms_m, r.noise_m) for r in results if r.residual_rms_m and r.noise_m
    ]
    misses = np.array([m for _, m, _ in swung])
    ratio = np.log([m / n for _, m, n in swung]) if swung else np.zeros(0)
    if (change := _change(ratio, LEAST_MISSED)) is not None:
        found.append(
            _signal("the model misses the swing by more", [c for c, _, _ in swung], misses, change)
        )
    return found


def _signal(
    what: str, folders: Sequence[str], sizes_m: FloatArray, change: tuple[int, int]
) -> Signal:
    since, at = change
    before = float(np.sqrt(np.mean(sizes_m[:since] ** 2)))
    after = float(np.sqrt(np.mean(sizes_m[since:] ** 2)))
    if after < before:
        what = what.replace("more", "less")
    return Signal(what, folders[since], folders[at], len(folders) - since, before, after)


def _change(values: FloatArray, least: float = 0.0) -> tuple[int, int] | None:
    """Index of the first value after a change, and of the one at which it shows; None if none.

    least  as in `standard_normal`
    """
    q = standard_normal(values, least)
    per_chart = FALSE_ALARM_CYCLES * CHARTS
    limit = -float(special.ndtri(0.5 / per_chart))
    reach = ewma_limit(per_chart, WEIGHT) * np.sqrt(WEIGHT / (2.0 - WEIGHT))
    mean, turned = 0.0, 0
    for i, value in enumerate(q):
        if not np.isfinite(value):
            continue
        if mean * value <= 0.0:
            turned = i  # where the moving average may have begun to drift away
        mean += WEIGHT * (float(value) - mean)
        if abs(value) > limit:
            return i, i
        if abs(mean) > reach:
            return turned, i
    return None


def standard_normal(values: FloatArray, least: float = 0.0) -> FloatArray:
    """(n,) independent standard normal values if `values` are normal of any mean and size.

    Each is judged by those before it alone, so that nobody has to know mean and size beforehand;
    nan while they are too few.
    least   added to their size, in square: with it what is smaller is no change
    source  Quesenberry 1991, SPC Q charts for start-up processes, J. Qual. Technol. 23, 213
    """
    q = np.full(len(values), np.nan)
    before = np.arange(FEWEST_BEFORE, len(values))
    if len(before) == 0:
        return q
    centred = values - values[0]  # so that sums of squares lose no digits
    mean = np.cumsum(centred)[before - 1] / before
    square = np.cumsum(centred**2)[before - 1] / before - mean**2
    size = np.sqrt(np.maximum(square, 0.0) * before / (before - 1.0) + least**2)
    known = size > 1e-12 * np.abs(values[before])
    t = np.sqrt(before / (before + 1.0)) * (centred[before] - mean) / np.where(known, size, 1.0)
    q[before] = np.where(known, -special.ndtri(special.stdtr(before - 1, -t)), np.nan)
    return q


@lru_cache(maxsize=8)
def ewma_limit(run_length: float, weight: float, states: int = 101) -> float:
    """Limit of an EWMA chart, in its standard deviations, with this mean time to a false alarm.

    source  Brook & Evans 1972, An approach to the probability distribution of CUSUM run length,
            Biometrika 59, 539; Lucas & Saccucci 1990, Technometrics 32, 1
    """

    def length(limit: float) -> float:
        high = limit * np.sqrt(weight / (2.0 - weight))
        edges = np.linspace(-high, high, states + 1)
        middle = 0.5 * (edges[1:] + edges[:-1])
        to = (edges[None, :] - (1.0 - weight) * middle[:, None]) / weight
        move = np.diff(special.ndtr(to), axis=1)
        return float(np.linalg.solve(np.eye(states) - move, np.ones(states))[states // 2])

    return float(optimize.brentq(lambda k: length(k) - run_length, 1.0, 6.0, xtol=1e-6))
