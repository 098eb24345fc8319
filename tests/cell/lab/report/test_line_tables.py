"""What the forecasts of all executions have in common is said for both models."""

from __future__ import annotations

import numpy as np

from cell.lab.line.forecasts import ForecastPair, TipForecast
from cell.lab.report.line_tables import common_error_line
from cell.records.model_errors import FEWEST


def pairs(present_mm: float, candidate_mm: float, count: int = 6) -> list[ForecastPair]:
    noise_mm = 0.05 * np.random.default_rng(1).standard_normal((count, 2))
    return [
        ForecastPair(str(i), *(TipForecast(1e-4, 1e-4, 1.0, m) for m in above_m))
        for i, above_m in enumerate(1e-3 * (noise_mm + np.array([present_mm, candidate_mm])))
    ]


def test_both_means_are_said_with_their_intervals() -> None:
    line = common_error_line(pairs(-0.6, 0.0))
    assert line.startswith("in the mean of 6 executions the tip passes the opening -0.")
    assert "above the present model's forecast, " in line and "above the candidate's" in line
    numbers = [float(w.strip("(),")) for w in line.split() if w.strip("(),")[:1] in "+-"]
    mean, low, high, after, after_low, after_high = numbers
    assert low < mean < high < -0.4 and after_low < after < after_high
    assert after_low < 0.0 < after_high


def test_holds_without_an_execution_do_not_count() -> None:
    hold = TipForecast(1e-4, 1e-4, 1.0)
    nothing = ForecastPair("h", hold, hold, "rest of the hold")
    assert "of 6 executions" in common_error_line([*pairs(0.1, 0.0), nothing, nothing])
    assert common_error_line([nothing] * 9) == ""
    assert common_error_line(pairs(0.6, 0.0, FEWEST - 1)) == ""
    assert common_error_line([]) == ""
