"""Projections off the fitted parameters of a model, by its linearised fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.identify.gaussian import covariance_root
from cell.lab.fit.fitting import Fit

#: Share of a change below which its projection is rounding error.
LEAST_SHARE = 1e-6


@dataclass(frozen=True)
class Projection:
    """A whitened residual, and derivatives by fitted parameters, as their QR decomposition.

    basis     (values, k) orthonormal: what the parameters can imitate
    triangle  (k, k)
    residual  (values,) with that part removed
    """

    basis: FloatArray
    triangle: FloatArray
    residual: FloatArray

    @staticmethod
    def of(residual: FloatArray, derivatives: FloatArray, independent: float = 0.0) -> Projection:
        """The projection of a residual (values,) by derivatives (values, k).

        independent  directions below this share of the strongest are dropped as rounding error
        """
        basis, triangle = np.linalg.qr(derivatives)
        if independent:
            strength = np.abs(np.diag(triangle))
            significant = strength > independent * max(strength.max(initial=0.0), 1e-300)
            basis, triangle = basis[:, significant], triangle[np.ix_(significant, significant)]
        return Projection(basis, triangle, residual - basis @ (basis.T @ residual))

    def moved(self, change: FloatArray) -> Projection:
        """The projection of a changed residual; the prior's rows, the last ones, do not change."""
        behind = len(self.residual) - len(change)
        moved = self.residual + self.remove(np.pad(change, (0, behind)))
        return Projection(self.basis, self.triangle, moved)

    def remove(self, rows: FloatArray) -> FloatArray:
        """(…, values) projected off the fitted parameters."""
        return np.asarray(rows - (rows @ self.basis) @ self.basis.T)

    def coordinates(self, rows: FloatArray) -> FloatArray:
        """(k, n) shift of the parameters by changes (n, values) of the residual."""
        return np.asarray(np.linalg.solve(self.triangle, self.basis.T @ rows.T))


def nuisance_of(fit: Fit) -> Projection:
    """The projection by all coordinates of a fit, those at a bound included."""
    return Projection.of(residual_with_prior(fit), jacobian_with_prior(fit), independent=1e-9)


def residual_with_prior(fit: Fit, mesh: FloatArray | float = 0.0) -> FloatArray:
    """(rows,) residual of a fit, moved by the mesh's error; the prior's rows last."""
    offset = np.concatenate([fit.q - fit.space.mean, fit.solution.q[len(fit.q) :]])
    return np.concatenate([fit.solution.residual + mesh, prior_root(fit) @ offset])


def jacobian_with_prior(fit: Fit) -> FloatArray:
    """(rows, p) derivatives by a fit's coordinates and initial states; the prior's rows last."""
    return np.vstack([fit.solution.jacobian, prior_root(fit)])


def prior_root(fit: Fit) -> FloatArray:
    """(rows, p) jacobian of the prior's residuals by the fit's coordinates and initial states."""
    p, rows = len(fit.q), len(fit.solution.q)
    precision = np.zeros((rows, rows))
    precision[:p, :p] = fit.space.precision
    # modes have a prior; a single delay has none
    if any(len(b) > 1 for b in fit.initial_states.values()):
        precision[p:, p:] = np.diag(1.0 / fit.initial_state_std**2)
    return np.asarray(covariance_root(precision).T)


def is_distinct(orthogonal: FloatArray, change: FloatArray) -> bool:
    """Whether more than rounding error of a change (…, values) is orthogonal to others."""
    return bool(np.linalg.norm(orthogonal) > LEAST_SHARE * np.linalg.norm(change))


def orthonormal(columns: FloatArray, least: float, *, of_largest: bool = False) -> FloatArray:
    """(values, k) orthonormal basis of the span of columns (values, n).

    least       smallest singular value of a direction in the basis
    of_largest  as a share of the largest
    """
    units, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    scale = max(float(sizes.max(initial=0.0)), 1e-300) if of_largest else 1.0
    return np.asarray(units[:, sizes > least * scale])
