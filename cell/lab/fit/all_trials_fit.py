"""A fitted model with derived quantities that several checks use, each computed once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import Options
from cell.lab.data.prepared import PreparedStudy, once_per_study, pooled
from cell.lab.fit.fitting import Fit, fit_model, fit_trials
from cell.lab.fit.sensitivity import Sensitivity, prior_root, sensitivities
from cell.lab.fit.systematic_error import SystematicError, systematic_error

#: What a pass gains below that share, of a model that errs, is far below what it could be wrong by.
CONVERGED = Options(tolerance=0.03, max_iterations=40, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class Linear:
    """The linearised fit: residual and derivatives in the free coordinates, the prior's rows last.

    basis, triangle  QR of the latter
    left             (rows,) of the residual, less the mesh's error, that nothing fitted explains
    """

    basis: FloatArray
    triangle: FloatArray
    left: FloatArray

    @staticmethod
    def of(fit: Fit, systematic_error: SystematicError) -> Linear:
        """Of a fit at its minimum."""
        solution, root = fit.solution, prior_root(fit)
        slopes = np.vstack([solution.jacobian, root])[:, solution.free]
        away = np.concatenate([fit.q - fit.space.mean, solution.q[len(fit.q) :]])
        residual = np.concatenate([solution.residual + systematic_error.mesh, root @ away])
        basis, triangle = np.linalg.qr(slopes)
        return Linear(basis, triangle, residual - basis @ (basis.T @ residual))

    def seen(self, rows: FloatArray) -> FloatArray:
        """(n, rows) without what the fitted coordinates imitate."""
        return np.asarray(rows - (rows @ self.basis) @ self.basis.T)

    def moved(self, rows: FloatArray) -> FloatArray:
        """(free coordinates, n) how far they move by changes (n, rows) of the residual."""
        return np.asarray(np.linalg.solve(self.triangle, self.basis.T @ rows.T))


@dataclass(frozen=True, eq=False)
class AllTrialsFit:
    """A model fitted to the `fit` trials of a study, with its systematic error and its jacobian."""

    prepared: PreparedStudy
    fit: Fit
    _slopes: dict[type[Effect], Sensitivity] = field(default_factory=dict)

    @cached_property
    def systematic_error(self) -> SystematicError:
        """By what the gripper log and the mesh may err."""
        return systematic_error(self.prepared, self.fit, fit_trials(self.prepared))

    @cached_property
    def linear(self) -> Linear:
        """What is left of the study near the fit."""
        return Linear.of(self.fit, self.systematic_error)

    def sensitivities(self, effects: Iterable[type[Effect]]) -> list[Sensitivity]:
        """What the amplitudes of effects do to the trials, in the order of the effects."""
        asked = list(effects)
        new = [e for e in asked if e not in self._slopes]
        if new:
            self._slopes.update({s.effect: s for s in sensitivities(self.prepared, self.fit, new)})
        return [self._slopes[e] for e in asked]


@once_per_study
def of_all_trials(prepared: PreparedStudy, fit: Fit) -> AllTrialsFit:
    """The model of a fit, fitted to every trial of its study.

    raises  UnsimulatedError: a trial cannot be simulated
    """
    together = pooled(prepared)
    return AllTrialsFit(
        together, fit_model(together, fit.space, fit.q, fit.initial_states, options=CONVERGED)
    )
