"""Profile likelihood against closed forms."""

import numpy as np
import pytest

from cell.identify.gauss_newton import LeastSquaresProblem, Options, minimise
from cell.identify.profile import profile

CLOSE = Options(tolerance=1e-3, max_iterations=60)
TARGET = 1.959964


def problem(residual, p, *, precision=None, low=None, high=None):
    return LeastSquaresProblem(
        residuals=lambda lanes: np.stack([residual(q) for q in lanes]),
        mean=np.zeros(p),
        precision=np.zeros((p, p)) if precision is None else precision,
        step=np.full(p, 1e-6),
        low=np.full(p, -1e9) if low is None else np.array(low),
        high=np.full(p, 1e9) if high is None else np.array(high),
    )


def test_of_a_linear_model_it_is_the_interval_of_the_curvature():
    rng = np.random.default_rng(0)
    design, seen = rng.normal(size=(30, 4)), rng.normal(size=30)
    posed = problem(lambda q: seen - design @ q, 4, precision=np.diag([0.0, 1.0, 0.0, 4.0]))
    found = minimise(posed, np.zeros(4), CLOSE)
    for i in range(4):
        of = profile(posed, found, i, CLOSE)
        reach = TARGET * np.sqrt(found.covariance[i, i])
        assert of.low == pytest.approx(found.q[i] - reach, abs=2e-3 * reach)
        assert of.high == pytest.approx(found.q[i] + reach, abs=2e-3 * reach)
        assert not of.better
        stds = (np.array([p.q for p in of.points]) - found.q[i]) * TARGET / reach
        assert [p.rise for p in of.points] == pytest.approx(stds**2, rel=1e-3, abs=1e-6)
        assert len(of.points) >= 7  # of a parabola drawn through five, none is seen
        assert np.abs(np.abs(stds) - 0.5).min() < 0.01


def test_of_a_curved_model_it_is_lopsided_as_the_likelihood():
    """exp(q) measured as 2 ± 0.5: the interval is that of exp(q), as logarithms."""
    posed = problem(lambda q: (np.exp(q) - 2.0) / 0.5, 1)
    of = profile(posed, minimise(posed, np.zeros(1), CLOSE), 0, CLOSE)
    assert of.low == pytest.approx(np.log(2.0 - 0.5 * TARGET), abs=0.03)
    assert of.high == pytest.approx(np.log(2.0 + 0.5 * TARGET), abs=0.01)
    assert of.high - np.log(2.0) < 0.75 * (np.log(2.0) - of.low)


def test_a_flat_direction_is_open():
    """Only the product is measured: every factor will do, and the curvature cannot say so."""
    posed = problem(
        lambda q: np.array([10.0 * (q[0] + q[1] - 1.0)]), 2, precision=1e-12 * np.eye(2)
    )
    of = profile(posed, minimise(posed, np.zeros(2), CLOSE), 0, CLOSE)
    assert (of.low, of.high) == (-np.inf, np.inf) or of.high - of.low > 1e5


def test_another_parameters_bound_is_marked_where_it_is_met():
    """x + y = 1 ± 0.1 and x alone 0.5 ± 10; from y's bound on, x is known to 0.1."""
    posed = problem(
        lambda q: np.array([(q[0] + q[1] - 1.0) / 0.1, (q[0] - 0.5) / 10.0]),
        2,
        low=[-100.0, -0.2],
        high=[100.0, 100.0],
    )
    of = profile(posed, minimise(posed, np.array([0.4, 0.6]), CLOSE), 0, CLOSE)
    assert of.high == pytest.approx(1.2 + 0.1 * TARGET, abs=0.05)
    assert any(1 in p.at_bound for p in of.points if p.q > 1.2)
    assert all(p.at_bound == () for p in of.points if p.q < 1.19)
    assert of.low == pytest.approx(0.5 - 10.0 * TARGET, abs=0.2)


def test_its_own_bound_ends_an_interval():
    posed = problem(lambda q: q - 0.5, 1, low=[0.0], high=[9.0])
    of = profile(posed, minimise(posed, np.ones(1), CLOSE), 0, CLOSE)
    assert of.low == 0.0
    assert of.high == pytest.approx(0.5 + TARGET, abs=0.01)


def test_a_lower_minimum_that_is_met_is_told():
    """Two minima near ±1, begun at the higher; the way between them is low enough to be gone."""
    posed = problem(lambda q: np.array([(q[0] ** 2 - 1.0) / 0.7, 0.6 * (q[0] + 1.0)]), 1)
    higher = minimise(posed, np.array([1.2]), CLOSE)
    lower = minimise(posed, np.array([-1.2]), CLOSE)
    assert higher.q[0] > 0.5 and lower.objective < higher.objective - 0.5
    assert profile(posed, higher, 0, CLOSE).better
    assert not profile(posed, lower, 0, CLOSE).better
