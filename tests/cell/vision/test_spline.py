"""The compiled curve against one that is fitted and evaluated by scipy."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from scipy.integrate import quad_vec
from scipy.interpolate import BSpline

from cell.vision.spline import INTERVALS, at, fit_cable, new_equations, new_pieces, roughness
from cell.vision.trace import median

from .entries import entry

KNOTS = np.pad(np.linspace(0.0, 1.0, INTERVALS + 1), 5, mode="edge")
SPLINES = BSpline(KNOTS, np.eye(INTERVALS + 5), 5)


@njit
def points_at(pieces, u):
    found = np.empty((len(u), 4))
    for n in range(len(u)):
        found[n] = at(pieces, u[n])
    return found


def fitted(u, points, weights):
    """Pieces of the compiled curve."""
    pieces = new_pieces()
    entry(fit_cable)(
        np.column_stack([points, np.zeros(len(u)), u, weights]), pieces, new_equations()
    )
    return pieces


def test_roughness_is_the_integral_of_the_third_derivative_squared():
    third = SPLINES.derivative(3)
    ends = np.linspace(0.0, 1.0, INTERVALS + 1)
    parts = [quad_vec(lambda u: np.outer(third(u), third(u)), a, b)[0] for a, b in pairwise(ends)]
    np.testing.assert_allclose(roughness(), sum(parts), rtol=1e-9, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), left_out=st.floats(0.0, 0.5))
def test_a_curve_is_fitted_as_by_scipy_and_goes_on_beyond_its_ends(seed, left_out):
    rng = np.random.default_rng(seed)
    u = np.sort(rng.uniform(0.0, 1.0, 250))
    points = np.stack([500.0 * u, 40.0 * np.sin(5.0 * u)], axis=1) + rng.normal(size=(250, 2))
    weights = np.where(rng.uniform(size=250) < left_out, 0.0, rng.uniform(0.1, 1.0, 250))
    b = SPLINES(u)
    weighted = (weights / weights.sum())[:, None] * b
    normal = b.T @ weighted + 1e-10 * roughness() + 1e-12 * np.eye(INTERVALS + 5)
    expected = BSpline(KNOTS, np.linalg.solve(normal, weighted.T @ points), 5)
    beyond = np.linspace(-0.02, 1.02, 400)
    found = points_at(fitted(u, points, weights), beyond)
    np.testing.assert_allclose(found[:, :2], expected(beyond), atol=1e-4)
    slope = expected.derivative()(beyond)
    np.testing.assert_allclose(found[:, 2:], slope, atol=1e-5 * np.abs(slope).max())


def test_noise_across_the_curve_does_not_lengthen_it():
    u = np.linspace(0.0, 1.0, 400)  # of a circle of radius 0.1 m, turned through 1 rad in all
    circle = 0.1 * np.stack([np.sin(u), 1.0 - np.cos(u)], axis=1)
    normals = np.stack([-np.sin(u), np.cos(u)], axis=1)
    noisy = circle + 5e-5 * np.random.default_rng(0).standard_normal(400)[:, None] * normals

    def length(points):
        return np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1))

    assert length(noisy) > 0.101  # what a polyline would say
    line = points_at(fitted(u, noisy, np.ones(400)), np.linspace(0.0, 1.0, 500))
    assert length(line[:, :2]) == pytest.approx(0.1, abs=2e-5)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60))
def test_the_median_is_numpys(values):
    scratch = np.array([values])
    assert entry(median)(scratch, len(values)) == pytest.approx(np.median(values))
