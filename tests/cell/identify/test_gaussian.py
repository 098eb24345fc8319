"""Roots and χ² against the dense covariance; steps against the bounds."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from cell.identify.gaussian import (
    covariance_root,
    marginal_chi2,
    marginal_products,
    parameters_root,
)
from cell.identify.parameters import difference_points, one_sided_steps


def test_the_root_of_a_singular_covariance_gives_it_back():
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(5, 3))
    covariance = spread @ spread.T
    root = covariance_root(covariance)
    assert root @ root.T == pytest.approx(covariance, abs=1e-12)
    assert np.all(np.diff(np.linalg.norm(root, axis=0)) >= -1e-12), "in order of rising size"


def test_the_likelihood_is_that_of_the_dense_covariance():
    rng = np.random.default_rng(1)
    residual, spread = rng.normal(size=20), 2.0 * rng.normal(size=(20, 4))
    chi2, log_det = marginal_chi2(residual, spread)
    dense = multivariate_normal(np.zeros(20), np.eye(20) + spread @ spread.T)
    expected = dense.logpdf(residual) + 10.0 * np.log(2.0 * np.pi)
    assert -0.5 * (chi2 + log_det) == pytest.approx(expected, rel=1e-12)


def test_a_step_that_would_leave_the_bounds_is_taken_backwards():
    q, step = np.array([0.0, 0.95, 1.0]), np.full(3, 0.1)
    steps = one_sided_steps(q, step, np.ones(3))
    np.testing.assert_array_equal(steps, [0.1, -0.1, -0.1])
    np.testing.assert_allclose(difference_points(q, steps)[1:] - q, np.diag(steps), atol=1e-15)


def test_a_root_of_parameters_keeps_those_of_small_units():
    """A moment in N·m beside a logarithm: its variance is 1e-20 of the other's."""
    size = np.array([0.3, 3e-11, 0.1])
    alike = np.array([[1.0, 0.5, -0.2], [0.5, 1.0, 0.1], [-0.2, 0.1, 1.0]])
    covariance = alike * np.outer(size, size)
    root = parameters_root(covariance)
    np.testing.assert_allclose(root @ root.T, covariance, rtol=1e-9)
    rounded = covariance_root(covariance)
    assert not np.allclose((rounded @ rounded.T)[1, 1], covariance[1, 1], rtol=0.1, atol=0.0)


def test_products_are_those_by_the_dense_covariance():
    rng = np.random.default_rng(4)
    rows, spread = rng.normal(size=(2, 6)), rng.normal(size=(6, 3))
    inverse = np.linalg.inv(np.eye(6) + spread @ spread.T)
    np.testing.assert_allclose(marginal_products(rows, spread), rows @ inverse @ rows.T)
    np.testing.assert_allclose(marginal_products(rows, np.zeros((6, 1))), rows @ rows.T)
