"""A fitted model with derived quantities that several checks use, each computed once."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property

from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.lab.data.prepared import PreparedStudy, once_per_study, pooled
from cell.lab.fit.fitting import Fit, fit_model, fit_trials
from cell.lab.fit.projection import Projection, jacobian_with_prior, residual_with_prior
from cell.lab.fit.sensitivity import Sensitivity, sensitivities
from cell.lab.fit.systematic_error import SystematicError, systematic_error

#: Smaller gains per iteration are far below the error of a model.
CONVERGED = Options(tolerance=0.03, max_iterations=40, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class AllTrialsFit:
    """A model fitted to the `fit` trials of a study, with its systematic error and its jacobian."""

    prepared: PreparedStudy
    fit: Fit
    _slopes: dict[type[Effect], Sensitivity] = field(default_factory=dict)

    @cached_property
    def systematic_error(self) -> SystematicError:
        """Possible errors by gripper log and mesh."""
        return systematic_error(self.prepared, self.fit, fit_trials(self.prepared))

    @cached_property
    def linear(self) -> Projection:
        """Projection of the residual, less the mesh's error, by the free coordinates."""
        residual = residual_with_prior(self.fit, self.systematic_error.mesh)
        return Projection.of(residual, jacobian_with_prior(self.fit)[:, self.fit.solution.free])

    def sensitivities(self, effects: Iterable[type[Effect]]) -> list[Sensitivity]:
        """Sensitivities of the trials to amplitudes of effects, in the order of the effects."""
        requested = list(effects)
        new = [e for e in requested if e not in self._slopes]
        if new:
            self._slopes.update({s.effect: s for s in sensitivities(self.prepared, self.fit, new)})
        return [self._slopes[e] for e in requested]


@once_per_study
def of_all_trials(prepared: PreparedStudy, fit: Fit) -> AllTrialsFit | None:
    """The model of a fit, fitted to every trial of its study; None if one cannot be simulated."""
    joint_study, states = pooled(prepared), fit.initial_states
    with suppress(*UNSIMULATED):
        joint = fit_model(joint_study, fit.space, fit.q, states, options=CONVERGED)
        return AllTrialsFit(joint_study, joint)
    return None
