"""Tests whether a line's errors have grown since its model was changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from cell.cable.arrays import FloatArray
from cell.records.result import Result

#: Cycles of either model that are compared: at least, and at most the first since the change and
#: the last before it.
FEWEST, MOST = 5, 20
#: One-sided, of ranks.  Looked at after every cycle, a model that is as good as the one before is
#: called worse in one change of 100 (3 of 400 simulated, of each quantity); of errors five times as
#: large three of four are told after 10 cables.
SIGNIFICANCE = 0.003
#: Differences below this share are nobody's concern.
WORSE = 1.2


@dataclass(frozen=True)
class Worsening:
    """A quantity that is larger since the model was changed.

    what      in words
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

    results  of any model, oldest first; nothing is said of a few
    """
    since, before = _newest_two(results)
    found = []
    for what, value in (
        ("forecasts err by more", _forecast_error_m),
        ("the model misses the swing by more", _missed_m),
    ):
        compared = _compared(what, _known(before, value)[-MOST:], _known(since, value)[:MOST])
        if compared is not None:
            found.append(compared)
    return found


def newest_models(results: Sequence[Result]) -> tuple[str, str] | None:
    """Hashes of the newest model and of the one used before it; None = there are no two."""
    since, before = _newest_two(results)
    pair = next((r.model for r in since), None), next((r.model for r in before), None)
    return None if pair[0] is None or pair[1] is None else (pair[0], pair[1])


def _newest_two(results: Sequence[Result]) -> tuple[list[Result], list[Result]]:
    """Results of the newest model, and of the one before it, each of the last time it was used."""
    known = (r for r in results if r.model is not None)
    runs = [list(run) for _, run in groupby(known, key=lambda r: r.model)]
    if len(runs) < 2:
        return [], []
    return runs[-1], runs[-2]


def _forecast_error_m(result: Result) -> float | None:
    if result.measured_miss_m is None or result.predicted_miss_m is None:
        return None
    return abs(result.measured_miss_m - result.predicted_miss_m)


def _missed_m(result: Result) -> float | None:
    return result.residual_rms_m


def _known(results: Sequence[Result], value: Callable[[Result], float | None]) -> FloatArray:
    return np.array([v for r in results if (v := value(r)) is not None])


def _compared(what: str, before: FloatArray, since: FloatArray) -> Worsening | None:
    if min(len(before), len(since)) < FEWEST:
        return None
    before_m, since_m = (float(np.sqrt(np.mean(v**2))) for v in (before, since))
    if since_m <= WORSE * before_m:
        return None
    from scipy.stats import mannwhitneyu  # half a second, of which only few have need

    p_value = float(mannwhitneyu(since, before, alternative="greater").pvalue)
    if p_value > SIGNIFICANCE:
        return None
    return Worsening(what, before_m, since_m, len(before), len(since), p_value)
