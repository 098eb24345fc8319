"""Gaussian distributions: the root of a covariance, and the χ² of correlated residuals."""

from __future__ import annotations

import numpy as np

from cell.cable.arrays import FloatArray


def covariance_root(covariance: FloatArray) -> FloatArray:
    """(p, p) R with R Rᵀ = covariance, by its eigenvectors, columns in order of rising size.

    covariance  (p, p) symmetric; eigenvalues below 0, which are rounding errors, count as 0
    """
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def parameters_root(covariance: FloatArray) -> FloatArray:
    """(p, p) R with R Rᵀ = covariance, of parameters whose units differ.

    Rounding errors are relative to the largest eigenvalue: a moment in N·m, or a mass in kg, would
    be lost compared with a logarithm.  So the root is that of the correlations, scaled.
    """
    size = np.sqrt(np.diag(covariance))
    size = np.where(size > 0.0, size, 1.0)
    return np.asarray(size[:, None] * covariance_root(covariance / np.outer(size, size)))


def marginal_products(rows: FloatArray, spread: FloatArray) -> FloatArray:
    """(m, m) products aᵀ C⁻¹ b of rows a, b of (m, n), with C = I + spread·spreadᵀ.

    spread  (n, k) what k standard normal unknowns add to n values
    source  Woodbury's identity: k × k instead of n × n
    """
    inner = np.eye(spread.shape[1]) + spread.T @ spread
    against = rows @ spread
    return np.asarray(rows @ rows.T - against @ np.linalg.solve(inner, against.T))


def marginal_chi2(residual: FloatArray, spread: FloatArray) -> tuple[float, float]:
    """χ² of residuals (n,) of covariance I + spread·spreadᵀ, and ln of its determinant.

    spread  (n, k) what k standard normal unknowns add to the residuals
    source  the matrix determinant lemma
    """
    inner = np.eye(spread.shape[1]) + spread.T @ spread
    chi2 = float(marginal_products(residual[None], spread)[0, 0])
    return chi2, float(np.linalg.slogdet(inner)[1])
