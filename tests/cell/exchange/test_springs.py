import numpy as np
import pytest

from cell.exchange.springs import TIP_ERROR_M, law, springs_for

LENGTH_M = 0.1


def test_linear_law_is_one_linear_spring():
    springs = springs_for(1.0, LENGTH_M)
    assert springs.linear.tolist() == [1.0]
    assert springs.cubic_m2.tolist() == [0.0]


@pytest.mark.parametrize("exponent", [0.8, 0.9, 0.97, 1.05, 1.15, 1.3])
def test_springs_follow_the_law(exponent):
    springs = springs_for(exponent, LENGTH_M)
    k = np.linspace(-np.pi / LENGTH_M, np.pi / LENGTH_M, 4001)
    secant = law(k, exponent) / np.where(k == 0.0, 1.0, k)
    error = (springs(k) - law(k, exponent)) / np.where(k == 0.0, 1.0, secant)
    # uniform bending by the error moves a tip by error · L²/2
    assert np.sqrt(np.mean(error**2)) * LENGTH_M**2 / 2 < TIP_ERROR_M
    assert np.allclose(springs(-k), -springs(k), atol=1e-12)


@pytest.mark.parametrize("exponent", [0.8, 1.3])
def test_springs_are_linear_and_stiff_beyond_their_range(exponent):
    springs = springs_for(exponent, LENGTH_M)
    far = springs(springs.range_1_per_m * np.array([2.0, 3.0, 4.0, 10.0]))
    slopes = np.diff(far) / (springs.range_1_per_m * np.array([1.0, 1.0, 6.0]))
    assert np.allclose(slopes, slopes[0], rtol=1e-6)
    assert slopes[0] > 0.2
