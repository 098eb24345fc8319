"""The compiled curve against the general one, which is fitted and evaluated by numpy and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from cell.vision.curve import fit_curve
from cell.vision.spline import INTERVALS, at, fit_cable, new_equations, new_pieces
from cell.vision.trace import median


@njit
def points_at(pieces, u):
    found = np.empty((len(u), 4))
    for n in range(len(u)):
        found[n] = at(pieces, u[n])
    return found


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), left_out=st.floats(0.0, 0.5))
def test_a_curve_is_fitted_as_by_numpy(seed, left_out):
    rng = np.random.default_rng(seed)
    u = np.sort(rng.uniform(0.0, 1.0, 250))
    points = np.stack([500.0 * u, 40.0 * np.sin(5.0 * u)], axis=1) + rng.normal(size=(250, 2))
    weights = np.where(rng.uniform(size=250) < left_out, 0.0, rng.uniform(0.1, 1.0, 250))
    expected = fit_curve(u, points, weights, INTERVALS, 1e-10)
    pieces = new_pieces()
    table = np.column_stack([points, np.zeros(250), u, weights])
    fit_cable(table, pieces, new_equations())
    beyond = np.linspace(-0.02, 1.02, 400)
    found = points_at(pieces, beyond)
    np.testing.assert_allclose(found[:, :2], expected.at(beyond), atol=1e-4)
    slope = expected.at(beyond, 1)
    np.testing.assert_allclose(found[:, 2:], slope, atol=1e-5 * np.abs(slope).max())


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60))
def test_the_median_is_numpys(values):
    scratch = np.array([values])
    assert median(scratch, len(values)) == pytest.approx(np.median(values))
