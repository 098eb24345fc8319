"""The directions in which single trials are asked for parameters of their own."""

import numpy as np
import pytest

from cell.lab.verdict.check_statistics import directions_of_trials


def information(slopes):
    return np.linalg.inv(slopes.T @ slopes)


def test_a_trial_is_asked_only_about_what_it_tells_of_the_parameters():
    """The second of two parameters is told by the first trial alone, the other hardly shows it."""
    slopes = np.zeros((10, 2))
    slopes[:5, 0], slopes[5:, 0] = 1.0, 1.0
    slopes[0, 1], slopes[5, 1] = 3.0, 0.01
    first, second = directions_of_trials(slopes, information(slopes), np.array([5, 10]))
    assert (first.shape, second.shape) == ((5, 2), (5, 1))
    np.testing.assert_allclose(first.T @ first, np.eye(2), atol=1e-12)


@pytest.mark.parametrize("units", [1.0, 1e-9])
def test_neither_units_nor_other_coordinates_change_what_is_asked(units):
    rng = np.random.default_rng(3)
    slopes = rng.normal(size=(40, 3))
    slopes[20:, 2] *= 0.02
    mixed = slopes @ rng.normal(size=(3, 3)) * np.array([1.0, units, 1.0])
    ends = np.array([20, 40])
    for one, other in zip(
        directions_of_trials(slopes, information(slopes), ends),
        directions_of_trials(mixed, information(mixed), ends),
        strict=True,
    ):
        np.testing.assert_allclose(one @ one.T, other @ other.T, atol=1e-5)
