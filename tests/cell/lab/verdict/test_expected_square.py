"""The distribution of a sum of squares that noise and common errors shift."""

import numpy as np
import pytest
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from cell.lab.verdict.smooth_part import ExpectedSquare


def test_of_noise_alone_all_values_count():
    found = ExpectedSquare.of(np.eye(7), 2.0, 40.0, np.zeros((7, 1)), 8)
    assert found.exceeded_with(0.01) == pytest.approx(14.0 * f_distribution.isf(0.01, 7, 40))
    assert found == ExpectedSquare(pytest.approx(14.0), pytest.approx(7.0), pytest.approx(40.0))


def test_of_white_noise_only_products_of_the_errors_are_needed():
    rng = np.random.default_rng(2)
    errors, draws = rng.normal(size=(9, 3)), 8
    dense = ExpectedSquare.of(np.eye(9), 1.3, 50.0, errors, draws)
    total = 1.3 * np.eye(9) + errors @ errors.T
    assert dense.mean == pytest.approx(np.trace(total))
    assert dense.dof == pytest.approx(np.trace(total) ** 2 / np.sum(total**2))
    found = ExpectedSquare.of_white(9, 1.3, 50.0, errors.T @ errors, draws)
    np.testing.assert_allclose(
        (found.mean, found.dof, found.dof_mean), (dense.mean, dense.dof, dense.dof_mean)
    )


def test_what_is_known_for_certain_has_no_uncertain_mean():
    found = ExpectedSquare.of(np.eye(3), 1.0, np.inf, np.zeros((3, 1)), 8)
    assert found.dof_mean == np.inf
    assert found.exceeded_with(0.01) == pytest.approx(chi2.isf(0.01, 3))


def test_an_error_common_to_all_values_leaves_little_more_than_one():
    found = ExpectedSquare.of(np.eye(10), 1.0, np.inf, 10.0 * np.ones((10, 1)), 1_000_000)
    assert found.mean == pytest.approx(1010.0)
    assert found.dof == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("size", [1.0, 4.0, 10.0])
def test_p_values_beside_a_few_large_errors_are_no_smaller_than_said(size):
    """Eight values, shifted by an error along one direction that eight draws tell the size of."""
    rng = np.random.default_rng(3)
    along, draws, small, naive = np.ones(8) / np.sqrt(8.0), 8, 0, 0
    for _ in range(4000):
        seen = rng.normal(size=8) + size * rng.normal() * along
        errors = size * np.outer(along, rng.normal(size=draws)) / np.sqrt(draws)
        found = ExpectedSquare.of(np.eye(8), 1.0, np.inf, errors, draws)
        ratio = float(seen @ seen) / found.mean
        small += f_distribution.sf(ratio, found.dof, found.dof_mean) < 0.01
        naive += chi2.sf(8 * ratio, 8) < 0.01
    assert small / 4000 < 0.025
    assert naive > (2 * small if size > 1.0 else small)  # were all values independent
