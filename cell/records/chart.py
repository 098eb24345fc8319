"""Control charts over a line's cycles: whether forecasts, fits or cables have changed, since when.

Two quantities, each on an individuals' chart for a sudden change and on an EWMA chart for a slow
one: the error of the tip's height in the opening over its forecast standard deviation, and the
logarithm of the model's rms residual of the swing over the noise.  Two more use the mean of the
newest five, because cables of a batch differ: mean log EI, and log viscosity after regression on
log EI.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import special

from cell.cable.arrays import FloatArray
from cell.records.result import Result

#: Mean number of cycles between false alarms of all charts together.
FALSE_ALARM_CYCLES = 1000.0
CHARTS = 6
#: Weight of the newest value in the moving average.
WEIGHT = 0.2
#: Number of earlier cycles that are needed to judge a cycle.
FEWEST_BEFORE = 8
#: Added in quadrature to the scatter of cables, because a few are outliers without any effect: for
#: the normalised forecast error, so that a single error below about 2 standard deviations is no
#: alarm, and for the log ratio of residual and noise.
LEAST_FORECAST, LEAST_MISSED = 0.5, 0.05
#: The same for cables' log EI and log viscosity: a smaller change is negligible.
LEAST_CABLES = 0.02
#: Number of cables whose mean parameters are judged.
TOGETHER = 5


@dataclass(frozen=True)
class ChartSignal:
    """A quantity that is outside its control limits.

    what      description
    since     folder of the first cycle of the change
    at        folder of the cycle at which it was noticed
    cycles    number of cycles since then
    before, after   root mean square before and since, m; for the cables' parameters the ratio to
                    those before, so that `before` is 1
    of_cables       whether it is the cables that have changed, not how well they are forecast
    """

    what: str
    since: str
    at: str
    cycles: int
    before: float
    after: float
    of_cables: bool = False

    def __str__(self) -> str:
        when = f"since {self.since}, for {self.cycles} cables"
        if self.of_cables:
            by = abs(self.after / self.before - 1.0)
            higher = "higher" if self.after > self.before else "lower"
            return f"{self.what} {when}: {by * 100:.0f} % {higher} than before"
        return (
            f"{self.what} {when}: {self.after * 1e3:.3f} mm rms, before {self.before * 1e3:.3f} mm"
        )


def signals(results: Sequence[Result]) -> list[ChartSignal]:
    """Control-chart signals in the cycles of one model, oldest first; none if they are few."""
    executed = [
        (r.folder, error_m, r.predicted_std_m)
        for r in results
        if (error_m := r.miss_error_m) is not None and r.predicted_std_m
    ]
    swung = [
        (r.folder, r.residual_rms_m, r.noise_m) for r in results if r.residual_rms_m and r.noise_m
    ]
    errors = standard_normal(np.array([e / s for _, e, s in executed]), LEAST_FORECAST)
    ratio = np.log([m / n for _, m, n in swung]) if swung else np.zeros(0)
    missed = standard_normal(ratio, LEAST_MISSED)
    return [
        *_of_errors("forecasts err by more", executed, errors),
        *_of_errors("the model misses the swing by more", swung, missed),
        *_of_cables(results),
    ]


def _of_errors(
    name: str, charted: Sequence[tuple[str, float, float]], q: FloatArray
) -> list[ChartSignal]:
    """Signals of errors, m: folder, error and what it is compared with; q  standard normal."""
    if (change := _change(q)) is None:
        return []
    since, at = change
    folders, sizes_m = [folder for folder, _, _ in charted], np.array([e for _, e, _ in charted])
    before = float(np.sqrt(np.mean(sizes_m[:since] ** 2)))
    after = float(np.sqrt(np.mean(sizes_m[since:] ** 2)))
    if after < before:
        name = name.replace("more", "less")
    return [ChartSignal(name, folders[since], folders[at], len(folders) - since, before, after)]


def _of_cables(results: Sequence[Result]) -> list[ChartSignal]:
    """Signals of EI and viscosity as identified: forecasts do not show them if every fit adapts."""
    charts = []
    known = [(r.folder, *logs) for r in results if (logs := _rigidity_and_viscosity(r.parameters))]
    folders = [folder for folder, _, _ in known]
    rigidity = np.array([x for _, x, _ in known])
    viscosity = np.array([y for _, _, y in known])
    for name, values, of in (
        ("cables' EI", rigidity, None),
        ("cables' viscosity, for their EI,", viscosity, rigidity),
    ):
        q = standard_normal(values, LEAST_CABLES, of, TOGETHER)
        if (change := _change(q, slow=False)) is None:
            continue
        at = change[1]
        before = slice(0, at - TOGETHER + 1)
        x, degree = (np.zeros(len(values)), 0) if of is None else (of, 1)
        away = values - np.polyval(np.polyfit(x[before], values[before], degree), x)
        newest = np.cumsum(away[at : before.stop - 1 : -1])  # of the newest one, two, … five
        since = at - int(np.argmax(np.abs(newest) / np.sqrt(np.arange(1, TOGETHER + 1))))
        after = float(np.exp(np.mean(away[since:])))
        charts.append(
            ChartSignal(name, folders[since], folders[at], len(folders) - since, 1.0, after, True)
        )
    return charts


def _rigidity_and_viscosity(parameters: Mapping[str, float]) -> tuple[float, float] | None:
    """Mean log EI and log viscosity of a cable; None = it was not identified."""
    rigidity = [v for n, v in parameters.items() if n.startswith("rigidity_")]
    viscosity = parameters.get("viscosity", 0.0)
    if not rigidity or min(*rigidity, viscosity) <= 0.0:
        return None
    return float(np.mean(np.log(rigidity))), float(np.log(viscosity))


def _change(q: FloatArray, slow: bool = True) -> tuple[int, int] | None:
    """Index of the first value after a change, and of its detection; None if there is none.

    q     standard normal; nan = not judged
    slow  whether a moving average may show it, too
    """
    per_chart = FALSE_ALARM_CYCLES * CHARTS
    limit = -float(special.ndtri(0.5 / per_chart))
    reach = ewma_limit(per_chart, WEIGHT) * np.sqrt(WEIGHT / (2.0 - WEIGHT)) if slow else np.inf
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


def standard_normal(
    values: FloatArray, least: float = 0.0, of: FloatArray | None = None, together: int = 1
) -> FloatArray:
    """(n,) standard normal values if `values` are normal of any mean and size.

    Each is judged by earlier values alone, so mean and scatter need not be known beforehand; nan
    while they are too few.
    least     added in quadrature to their scatter, so that smaller changes give no signal
    of        (n,) regressor of the mean, which is linear in it, estimated from earlier values
    together  number of values, the newest at this index, whose mean is judged by earlier ones;
              for 1 the results are independent
    source    Quesenberry 1991, SPC Q charts for start-up processes, J. Qual. Technol. 23, 213; with
              `of`, recursive residuals: Brown, Durbin & Evans 1975, J. R. Stat. Soc. B 37, 149
    """
    q = np.full(len(values), np.nan)
    newest = np.arange(FEWEST_BEFORE + together - 1, len(values))
    if len(newest) == 0:
        return q
    n = newest + 1 - together  # so many are before
    y = values - values[0]  # so that sums of squares lose no digits
    away, square = _newest_and_before(y, y, n, together)
    freedom, wider = n - 1, 1.0 / together + 1.0 / n
    if of is not None:
        x = of - of[0]
        away_x, square_x = _newest_and_before(x, x, n, together)
        square_x = np.maximum(square_x, 1e-12)
        slope = _newest_and_before(x, y, n, together)[1] / square_x
        away, freedom = away - slope * away_x, n - 2
        square, wider = square - slope**2 * square_x, wider + away_x**2 / square_x
    size = np.sqrt(np.maximum(square, 0.0) / freedom + least**2)
    known = size > 1e-12 * np.abs(values[newest])
    t = away / np.where(known, size * np.sqrt(wider), 1.0)
    q[newest] = np.where(known, -special.ndtri(special.stdtr(freedom, -t)), np.nan)
    return q


def _newest_and_before(
    x: FloatArray, y: FloatArray, n: NDArray[np.int64], together: int
) -> tuple[FloatArray, FloatArray]:
    """Difference between the mean of y[n : n + together] and that of the n values before; the sum
    of products of x and y of these about their means.
    """
    sum_x, sum_y = np.cumsum(x), np.cumsum(y)
    mean = sum_y[n - 1] / n
    newest = (sum_y[n + together - 1] - sum_y[n - 1]) / together
    return newest - mean, np.cumsum(x * y)[n - 1] - sum_x[n - 1] * mean


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

    low, high = 1.0, 6.0
    while high - low > 1e-6:
        limit = 0.5 * (low + high)
        low, high = (limit, high) if length(limit) < run_length else (low, limit)
    return 0.5 * (low + high)
