import hashlib
from dataclasses import replace

import numpy as np
import pytest

from cell.identify.gauss_newton import LeastSquaresProblem, Options, minimise

#: NIST StRD Misra1a: y = b1 (1 − exp(−b2 x)); certified values and standard deviations.
MISRA1A = np.array(
    [
        [10.07, 77.6],
        [14.73, 114.9],
        [17.94, 141.1],
        [23.93, 190.8],
        [29.61, 239.9],
        [35.18, 289.0],
        [40.02, 332.8],
        [44.82, 378.4],
        [50.76, 434.8],
        [55.05, 477.3],
        [61.01, 536.8],
        [66.40, 593.1],
        [75.47, 689.1],
        [81.78, 760.0],
    ]
)
CERTIFIED = np.array([2.3894212918e02, 5.5015643181e-04])
CERTIFIED_STD = np.array([2.7070075241, 7.2668688436e-06])
RESIDUAL_STD = 1.0187876330e-01


def misra(low: float = -np.inf, high: float = np.inf) -> LeastSquaresProblem:
    """In logarithms of the parameters, with hardly any prior."""

    def residuals(lanes: np.ndarray) -> np.ndarray:
        b1, b2 = np.exp(lanes.T)[:, :, None]
        y, x = MISRA1A.T
        return (y - b1 * (1.0 - np.exp(-b2 * x))) / RESIDUAL_STD

    return LeastSquaresProblem(
        residuals,
        np.log([500.0, 1e-4]),
        1e-9 * np.eye(2),
        np.full(2, 1e-6),
        np.array([-np.inf, low]),
        np.array([np.inf, high]),
    )


@pytest.mark.parametrize("updates", [0, 3])
@pytest.mark.parametrize("start", [(500.0, 1e-4), (250.0, 5e-4), (100.0, 2e-3)])
def test_nist_certified_values_and_standard_deviations(
    start: tuple[float, float], updates: int
) -> None:
    solution = minimise(misra(), np.log(start), Options(tolerance=1e-4, updates=updates))
    assert solution.converged
    np.testing.assert_allclose(np.exp(solution.q), CERTIFIED, rtol=1e-5)
    std = np.sqrt(np.diag(solution.covariance)) * CERTIFIED
    np.testing.assert_allclose(std, CERTIFIED_STD, rtol=1e-3)
    assert solution.objective == pytest.approx(12.0, rel=1e-5)  # 14 data, 2 parameters


def test_a_fit_left_early_knows_how_far_the_minimum_still_is() -> None:
    early = minimise(misra(), np.log((260.0, 5e-4)), Options(tolerance=1e-4, max_iterations=1))
    assert not early.converged
    assert early.promised > 1.0
    np.testing.assert_allclose(np.exp(early.q + early.remaining_step), CERTIFIED, rtol=0.02)
    std = np.sqrt(np.diag(early.covariance + early.unfinished))
    assert np.all(np.abs(early.q - np.log(CERTIFIED)) < 1.96 * std)
    assert np.any(np.abs(early.q - np.log(CERTIFIED)) > 1.96 * np.sqrt(np.diag(early.covariance)))
    arrived = minimise(misra(), np.log((250.0, 5e-4)), Options(tolerance=1e-4))
    assert not arrived.unfinished.any()
    assert arrived.promised == 0.0


def test_jacobians_that_are_updated_save_most_lanes_and_find_the_same() -> None:
    counts, found = [], []
    for updates in (0, 3):
        lanes: list[int] = []
        residuals = misra().residuals
        counted = replace(misra(), residuals=lambda q: lanes.append(len(q)) or residuals(q))  # noqa: B023
        solution = minimise(counted, np.log([500.0, 1e-4]), Options(1e-4, updates=updates))
        counts.append(sum(n > 1 for n in lanes))
        found.append(np.concatenate([solution.q, solution.jacobian.ravel()]))
    assert counts[1] < counts[0] / 2
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4)


def test_a_bound_is_kept_and_the_rest_is_fitted_beside_it() -> None:
    bound = np.log(6e-4)
    solution = minimise(misra(low=bound), np.log([250.0, 8e-4]), Options(tolerance=1e-4))
    assert solution.converged
    assert solution.q[1] == bound
    assert solution.free.tolist() == [True, False]
    rise = 1.0 - np.exp(-6e-4 * MISRA1A[:, 1])
    best = rise @ MISRA1A[:, 0] / (rise @ rise)
    assert np.exp(solution.q[0]) == pytest.approx(best, rel=1e-5)


def test_the_prior_decides_what_the_data_do_not() -> None:
    problem = LeastSquaresProblem(
        lambda lanes: lanes[:, :1] - 3.0,
        np.array([0.0, 7.0]),
        np.diag([1.0, 4.0]),
        np.full(2, 1e-3),
        np.full(2, -np.inf),
        np.full(2, np.inf),
    )
    solution = minimise(problem, np.zeros(2))
    np.testing.assert_allclose(solution.q, [1.5, 7.0], atol=1e-9)
    np.testing.assert_allclose(solution.covariance, np.diag([0.5, 0.25]), atol=1e-9)


def test_lanes_that_cannot_be_computed_are_stepped_back_from() -> None:
    def residuals(lanes: np.ndarray) -> np.ndarray:
        return np.where(lanes > 1.2, np.inf, 1.0 / np.maximum(lanes, 1e-3) - 1.0)

    problem = LeastSquaresProblem(
        residuals, np.zeros(1), np.zeros((1, 1)), np.full(1, 1e-6), np.zeros(1), np.full(1, 10.0)
    )
    solution = minimise(problem, np.array([0.1]), Options(tolerance=1e-8))
    assert solution.converged
    assert solution.q[0] == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(ValueError, match="cannot be simulated"):
        minimise(problem, np.array([5.0]))


def test_too_few_passes_is_said() -> None:
    solution = minimise(misra(), np.log([500.0, 1e-4]), Options(max_iterations=1))
    assert not solution.converged


@pytest.mark.parametrize("updates", [0, 3])
def test_far_along_a_narrow_valley_is_not_called_converged(updates: int) -> None:
    """Rosenbrock's valley, a hundred times narrower than long: damped steps across it are tiny."""

    def residuals(lanes: np.ndarray) -> np.ndarray:
        x, y = lanes.T
        return np.stack([100.0 * (y - x**2), 10.0 * (1.0 - x)], axis=1)

    wide = np.full(2, 10.0)
    problem = LeastSquaresProblem(
        residuals, np.zeros(2), np.zeros((2, 2)), np.full(2, 1e-6), -wide, wide
    )
    solution = minimise(
        problem, np.array([-1.2, 1.44]), Options(max_iterations=100, updates=updates)
    )
    assert solution.converged
    assert solution.q == pytest.approx([1.0, 1.0], abs=1e-4)


@pytest.mark.parametrize("updates", [0, 3])
def test_slopes_may_come_from_residuals_that_are_all_wrong_by_as_much(updates: int) -> None:
    """As a coarser simulation's are: the minimum is that of the residuals themselves."""
    exact, asked = misra(), []

    def residuals(lanes: np.ndarray) -> np.ndarray:
        asked.append(len(lanes))
        return exact.residuals(lanes)

    near = replace(exact, residuals=residuals, jacobian=lambda q: exact.residuals(q) + 3.0)
    solution = minimise(near, np.log((250.0, 5e-4)), Options(tolerance=1e-4, updates=updates))
    assert solution.converged
    np.testing.assert_allclose(np.exp(solution.q), CERTIFIED, rtol=1e-5)
    np.testing.assert_allclose(
        np.sqrt(np.diag(solution.covariance)) * CERTIFIED, CERTIFIED_STD, rtol=1e-3
    )
    assert set(asked) == {1}  # never beside their finite differences


def test_a_known_jacobian_at_the_start_is_not_computed_again() -> None:
    exact, asked = misra(), []

    def residuals(lanes: np.ndarray) -> np.ndarray:
        asked.append(len(lanes))
        return exact.residuals(lanes)

    options = Options(tolerance=1e-4, updates=3)
    near = minimise(exact, np.log((250.0, 5e-4)), options)
    again = minimise(replace(exact, residuals=residuals), near.q, options, near.jacobian)
    assert again.converged
    assert asked == [1]
    np.testing.assert_allclose(np.exp(again.q), CERTIFIED, rtol=1e-5)


def test_slopes_that_cannot_be_had_are_taken_from_the_residuals() -> None:
    near = replace(misra(), jacobian=lambda q: np.full((len(q), len(MISRA1A)), np.nan))
    solution = minimise(near, np.log((250.0, 5e-4)), Options(tolerance=1e-4))
    np.testing.assert_allclose(np.exp(solution.q), CERTIFIED, rtol=1e-5)


def test_a_rough_objective_is_left_once_passes_gain_nothing() -> None:
    """Ripples of 0.3 in χ² all over a valley, as friction makes them: each promises a way down."""

    def residuals(lanes: np.ndarray) -> np.ndarray:
        ripples = 5.0 + 0.03 * np.sin(1e3 * lanes)
        return np.hstack([300.0 * (lanes - 1.0), ripples, np.ones((len(lanes), 100))])

    bounds, none = np.full(2, np.inf), np.zeros(2)
    rough = LeastSquaresProblem(
        residuals, none, 1e-9 * np.eye(2), np.full(2, 1e-4), -bounds, bounds
    )
    solution = minimise(rough, np.array([3.0, -2.0]), Options(max_iterations=40, updates=3))
    assert solution.converged_or_idle
    assert solution.iterations <= 12
    np.testing.assert_allclose(solution.q, 1.0, atol=1.0 / 300.0)


def test_a_fit_that_stays_far_above_another_is_given_up() -> None:
    begin = np.log([500.0, 1e-4])
    whole = minimise(misra(), begin, Options(tolerance=1e-4))
    hurried = Options(tolerance=1e-4, above=(1e2 * whole.objective, 3))
    given_up = minimise(misra(), begin, hurried)
    assert given_up.iterations == 3 < whole.iterations
    assert not given_up.converged and not given_up.converged_or_idle
    assert given_up.objective > 1e2 * whole.objective
    kept = minimise(misra(), begin, replace(hurried, above=(1e9 * whole.objective, 3)))
    np.testing.assert_array_equal(kept.q, whole.q)


def test_differences_reach_no_further_than_the_data_leave_open() -> None:
    """A ringing's beginning, known to 20 µs, was moved by 5 ms: its slope was of the wrong sign."""
    t_s = np.linspace(0.0, 1.0, 4000)

    def residuals(lanes: np.ndarray) -> np.ndarray:
        """Of a wave of 40 Hz, its phase in seconds; half a period is 12.5 ms."""
        size, late_s = lanes.T[:, :, None]
        wave = size * np.sin(2.0 * np.pi * 40.0 * (t_s - late_s))
        return (wave - np.sin(2.0 * np.pi * 40.0 * (t_s - 1e-3))) / 1e-3

    step, wide = np.array([1e-3, 0.011]), np.full(2, 10.0)
    problem = LeastSquaresProblem(residuals, np.zeros(2), np.zeros((2, 2)), step, -wide, wide)
    solution = minimise(problem, np.array([0.9, 0.0]), Options(tolerance=0.01, updates=3))
    assert solution.converged
    np.testing.assert_allclose(solution.q, [1.0, 1e-3], atol=1e-6)
    assert np.sqrt(solution.covariance[1, 1]) == pytest.approx(
        1e-3 / (2.0 * np.pi * 40.0 * np.sqrt(0.5 * len(t_s))), rel=0.02
    )


def test_where_slopes_grow_as_fast_as_steps_shrink_differences_are_not_taken_on_and_on() -> None:
    """A comparison took ten minutes of them, where the cable could hardly be simulated."""
    batches, size = [0], 12

    def residuals(lanes: np.ndarray) -> np.ndarray:
        """No two places have anything in common."""
        batches[0] += 1
        digests = [hashlib.blake2b(lane.tobytes() + b"\0", digest_size=8) for lane in lanes]
        seeds = [int.from_bytes(d.digest(), "little") for d in digests]
        return np.array([3.0 * np.random.default_rng(s).standard_normal(size) for s in seeds])

    wide = np.full(size, 10.0)
    start, step = np.zeros(size), np.full(size, 1e-2)
    rough = LeastSquaresProblem(residuals, start, 1e-4 * np.eye(size), step, -wide, wide)
    minimise(rough, start, Options(max_iterations=1))
    assert batches[0] <= 5


def test_a_fit_ends_where_it_is_when_no_more_work_is_afforded() -> None:
    whole = minimise(misra(), np.log([500.0, 1e-4]), Options(tolerance=1e-4))
    asked: list[None] = []

    def affordable() -> bool:
        asked.append(None)
        return len(asked) < 3

    problem = replace(misra(), affordable=affordable)
    ended = minimise(problem, np.log([500.0, 1e-4]), Options(tolerance=1e-4))
    assert ended.iterations == 3 < whole.iterations
    assert not ended.converged and not ended.converged_or_idle
    assert whole.objective < ended.objective
