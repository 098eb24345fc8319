"""The engine's own elementary functions against numpy's."""

import numpy as np
import pytest
from numba import njit

from cell.cable.numerics import exponential, power, settling_time, sincos


@njit
def over(x):
    out = np.empty((3, x.size))
    for k in range(x.size):
        out[0, k], out[1, k] = sincos(x[k])
        out[2, k] = exponential(x[k])
    return out


@njit
def powers(x, e):
    out = np.empty(x.size)
    for k in range(x.size):
        out[k] = power(x[k], e[k])
    return out


@njit
def settled(decay, duration):
    return settling_time(decay, duration)


def test_sine_cosine_exponential():
    x = np.concatenate([np.linspace(-50, 50, 20001), np.linspace(-1e-8, 1e-8, 11)])
    sine, cosine, grown = over(x)
    assert np.abs(sine - np.sin(x)).max() < 3e-16
    assert np.abs(cosine - np.cos(x)).max() < 3e-16
    assert grown == pytest.approx(np.exp(x), rel=2e-14)


def test_power():
    rng = np.random.default_rng(0)
    x, e = np.exp(rng.uniform(-12, 12, 5000)), rng.uniform(-1, 1, 5000)
    assert powers(x, e) == pytest.approx(x**e, rel=1e-11)


@pytest.mark.parametrize("decay", [0.0, 1e-6, 0.3, 20.0, 1e6, -3.0])
def test_a_memory_that_settles_is_the_exact_solution(decay):
    exact = 2.0 * 0.5 if decay == 0.0 else -2.0 * np.expm1(-decay * 0.5) / decay
    assert 2.0 * settled(decay, 0.5) == pytest.approx(exact, rel=1e-9)
