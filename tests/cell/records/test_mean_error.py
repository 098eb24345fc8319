"""The error that forecasts have in common is told with its interval, and chance is not."""

from __future__ import annotations

import numpy as np
import pytest

from cell.records.model_errors import CONFIDENCE, FEWEST, MOST_MEAN, REPEATABILITY_M, mean_error
from cell.records.result import Outcome, Result


def cycles(errors_m: np.ndarray) -> list[Result]:
    planned = np.random.default_rng(3).normal(0.0, 1e-3, len(errors_m))
    return [
        Result(i, Outcome.INSERTED, f"c{i}", predicted_miss_m=p, measured_miss_m=p + e)
        for i, (p, e) in enumerate(zip(planned, errors_m, strict=True), 1)
    ]


def test_a_common_error_is_told_with_its_interval() -> None:
    errors_m = 6e-4 + np.random.default_rng(1).normal(0.0, 1e-4, 12)
    found = mean_error(cycles(errors_m))
    assert found is not None and found.cycles == 12
    assert found.mean_m == pytest.approx(errors_m.mean())
    assert found.low_m < 6e-4 < found.high_m
    text = str(found)
    assert f"{errors_m.mean() * 1e3:.2f} mm above their forecast" in text and "12 cables" in text


def test_the_sign_is_said_in_words() -> None:
    found = mean_error(cycles(np.full(6, -5e-4) + 1e-6 * np.arange(6)))
    assert found is not None and "0.50 mm below" in str(found) and "-" not in str(found)


def test_half_of_the_errors_may_lie_on_either_side() -> None:
    """The interval covers what it says: of many samples of a Student law."""
    rng, covered = np.random.default_rng(2), []
    for _ in range(2000):
        found = mean_error(cycles(2e-3 + rng.normal(0.0, 3e-4, 8)))
        assert found is not None
        covered.append(found.low_m < 2e-3 < found.high_m)
    assert np.mean(covered) >= CONFIDENCE - 0.003


def test_chance_is_not_told() -> None:
    """Looked at after each of 200 cables of 100 lines without a common error."""
    rng = np.random.default_rng(4)
    told = [
        mean_error(cycles(line[:n]))
        for line in rng.normal(0.0, 2e-4, (100, 60))
        for n in range(FEWEST, 60, 5)
    ]
    assert sum(t is not None for t in told) <= 2


def test_what_is_smaller_than_an_arm_repeats_to_is_not_told() -> None:
    small = np.full(40, 0.9 * REPEATABILITY_M) + 1e-9 * np.arange(40)
    assert mean_error(cycles(small)) is None


def test_few_or_unexecuted_cables_tell_nothing() -> None:
    assert mean_error([]) is None
    assert mean_error(cycles(np.full(FEWEST - 1, 1e-3))) is None
    rejected = [Result(1, Outcome.REJECTED, "c", predicted_miss_m=1e-3)] * 9
    assert mean_error(rejected) is None


def test_only_the_newest_count() -> None:
    old_and_new = np.concatenate([np.full(100, 2e-3), 1e-6 * np.arange(MOST_MEAN)])
    assert mean_error(cycles(old_and_new)) is None
