"""Residual of an effect held at a given size, while all other parameters are refitted.

The jacobian says how much of an effect the other parameters can imitate.  Where they imitate most
of it, the remainder is small compared with second-order terms, and a fit with the effect held is
needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import ActiveEffect, Effect
from cell.identify.gauss_newton import Options
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import Fit, by_trial, extended, fit_model, fit_trials, space_with
from cell.lab.fit.projection import jacobian_with_prior, prior_root

_REFIT = Options(tolerance=0.1, max_iterations=15, least_gain=1e-3, updates=3)


@dataclass(frozen=True, eq=False)
class HeldEffect:
    """An effect added to a fitted model, with one amplitude and the shape held.

    amplitude  number of the parameter that is held; other amplitudes are free

    Changes are whitened, of the fit trials, the prior's rows included.
    """

    prepared: PreparedStudy
    fit: Fit
    effect: type[Effect]
    amplitude: int

    @cached_property
    def space(self) -> ParameterSpace:
        """Parameters of the model with the effect."""
        return space_with(self.fit.space, (*self.fit.space.effects, self.effect))

    @cached_property
    def _held(self) -> list[int]:
        """Indices of the held parameters."""
        return [
            self.space.names.index(f"{self.effect.name}.{p.name}")
            for i, p in enumerate(self.effect.parameters)
            if i == self.amplitude or not p.amplitude
        ]

    def response(self, active: ActiveEffect, change: FloatArray, others: FloatArray) -> FloatArray:
        """(p + unknowns of initial states,) coordinates of a linear refit with the effect held.

        change  (rows,) of the observations by the effect alone
        others  (n, rows) the same per unit of each of its free amplitudes
        """
        jacobian = jacobian_with_prior(self.fit)
        step = np.linalg.lstsq(np.column_stack([jacobian, -others.T]), change, rcond=None)[0]
        p, all_q = len(self.fit.q), jacobian.shape[1]
        values = np.array(active.values)
        amplitudes = [i for i, x in enumerate(self.effect.parameters) if x.amplitude]
        values[[i for i in amplitudes if i != self.amplitude]] += step[all_q:]
        q = extended(self.fit, self.space, self.effect, values)
        q[:p] += step[:p]
        q = np.clip(q, self.space.low, self.space.high)
        return np.concatenate([q, self.fit.solution.q[p:] + step[p:all_q]])

    def at(self, active: ActiveEffect, base: FloatArray | None) -> FloatArray:
        """Coordinates with the held parameters set, the others from `base`; None = from the fit."""
        q = extended(self.fit, self.space, self.effect, np.array(active.values))
        if base is None:
            return np.concatenate([q, self.fit.solution.q[len(self.fit.q) :]])
        moved = base.copy()
        moved[self._held] = q[self._held]
        return moved

    def refitted(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The model's coordinates refitted from q, the effect held as there, and the change.

        raises  UnsimulatedError: it cannot be simulated there
        """
        low, high = self.space.low.copy(), self.space.high.copy()
        low[self._held] = high[self._held] = q[self._held]
        space = replace(self.space, low=low, high=high)
        fit = fit_model(
            self.prepared, space, q[: len(space.names)], self.fit.initial_states, options=_REFIT
        )
        change = self.fit.solution.residual - fit.solution.residual
        return fit.solution.q, self._with_prior(fit.solution.q, change)

    def _with_prior(self, q: FloatArray, change: FloatArray) -> FloatArray:
        p, fit = len(self.fit.q), self.fit
        moved = np.concatenate([q[:p], q[len(self.space.names) :]]) - fit.solution.q
        return np.concatenate([change, -prior_root(fit) @ moved])


def all_changes(held: Sequence[HeldEffect], q: Sequence[FloatArray]) -> list[FloatArray]:
    """(rows,) change from the fit by each held effect at its q, simulated in one batch.

    held  of the same fit
    q     (p + unknowns of initial states,) of each
    """
    if not held:
        return []
    prepared, fit = held[0].prepared, held[0].fit
    trials = fit_trials(prepared)
    places = [(h, len(h.space.names), q_one) for h, q_one in zip(held, q, strict=True)]
    models = [fit.model, *(h.space.model(q_one[:p]) for h, p, q_one in places)]
    states = np.stack([fit.solution.q[len(fit.q) :], *(q_one[p:] for _, p, q_one in places)])
    white = prepared.white_near(trials, models, by_trial(prepared, trials, states))
    changes = white[0] - white[1:]
    return [h._with_prior(q_one, row) for (h, _, q_one), row in zip(places, changes, strict=True)]
