"""The mean of several values, the spread between them, and an interval that holds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.lab.fit.shared import Spread
from cell.lab.line.together import pool


def test_values_that_agree_are_weighed_by_their_precision() -> None:
    values, std = np.array([1.0, 1.1, 0.9]), np.array([0.1, 0.1, 0.2])
    found = pool(values, std)
    weights = 1.0 / std**2
    assert found.spread.tau == 0.0
    assert found.mean == pytest.approx(np.sum(weights * values) / weights.sum())
    assert found.without[2] == pytest.approx(1.05)
    assert found.spread.p_value > 0.5


@pytest.mark.parametrize("tau", [0.0, 0.3])
def test_the_interval_holds_the_mean_of_all_cables(tau: float) -> None:
    """By simulation, with cables that are alike and that are not: nominal 95 %."""
    rng = np.random.default_rng(4)
    inside = 0
    for _ in range(400):
        std = rng.uniform(0.1, 0.3, 6)
        found = pool(rng.normal(0.0, np.hypot(std, tau)), std)
        inside += abs(found.mean) <= found.reach
    assert 0.92 <= inside / 400 <= 0.995


def test_a_single_value_is_its_own_mean() -> None:
    found = pool(np.array([2.0]), np.array([0.5]))
    assert (found.mean, found.spread.tau, found.without.tolist()) == (2.0, 0.0, [2.0])
    assert found.reach == pytest.approx(0.98, abs=0.001)


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(0.01, 3)), min_size=2, max_size=9))
def test_the_mean_lies_between_the_values(pairs: list[tuple[float, float]]) -> None:
    values, std = np.array(pairs).T
    found = pool(values, std)
    assert values.min() - 1e-9 <= found.mean <= values.max() + 1e-9
    assert found.reach > 0.0


def test_the_spread_between_cables_is_that_of_restricted_maximum_likelihood() -> None:
    """Against a direct search for the maximum; the data are of unequal precision."""
    values = np.array([1.8, 2.3, 2.0, 2.9, 1.5])
    std = np.array([0.1, 0.2, 0.15, 0.3, 0.1])
    found = Spread.of(values, std)

    def log_likelihood(tau: float) -> float:
        w = 1.0 / (std**2 + tau**2)
        mean = np.average(values, weights=w)
        return float(
            0.5 * np.sum(np.log(w)) - 0.5 * np.log(w.sum()) - 0.5 * np.sum(w * (values - mean) ** 2)
        )

    grid = np.linspace(0.0, 2.0, 20_001)
    assert found.tau == pytest.approx(grid[np.argmax([log_likelihood(t) for t in grid])], abs=2e-4)
    assert found.p_value < 0.01
    assert Spread.of(np.array([2.0, 2.01]), np.array([0.1, 0.1])).tau == 0.0
