"""Errors of a simulation and of the gripper log, in addition to the noise of the markers.

With an `AllTrialsFit`, a model fitted to all trials, these errors are computed once.

With many frames an effect is detectable that moves a marker by a thousandth of the noise: far less
than the errors by a simulation's mesh and step, or by 10 µm of noise in the gripper log.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect
from cell.identify.gauss_newton import UNSIMULATED, Options
from cell.identify.gripper_errors import GripperLogErrors, sampled_motions
from cell.lab.data.prepared import PreparedStudy, once_per_study, pooled
from cell.lab.fit.corrections import REMAINDER, finer
from cell.lab.fit.fitting import Fit, fit_model, fit_trials
from cell.lab.fit.projection import Projection, jacobian_with_prior, residual_with_prior
from cell.lab.fit.sensitivity import Sensitivity, sensitivities
from cell.study.data import Trial

#: Motions of the gripper drawn for every trial.
MOTIONS = 8


@dataclass(frozen=True, eq=False)
class GripperLogError:
    """Whitened changes of residuals for gripper motions sampled from the log's error model.

    rows  per trial (motions, rows)
    """

    rows: Mapping[str, FloatArray]

    def inflation(self, changes: Mapping[str, FloatArray]) -> float:
        """Variance of residuals along a direction, over that by noise alone; 1 or more.

        The χ² that a further effect explains along this direction is divided by it.
        changes  per trial (rows,): the direction
        """
        size = sum(float(change @ change) for change in changes.values())
        if not (np.isfinite(size) and size > 0.0):
            return 1.0
        by_log = sum(
            float(np.sum((self.rows[name] @ change) ** 2)) for name, change in changes.items()
        )
        return 1.0 + by_log / (MOTIONS * size)

    def square(self, trials: Sequence[Trial]) -> float:
        """Expected χ² that the log's error adds in trials."""
        return sum(float(np.sum(self.rows[t.name] ** 2)) for t in trials) / MOTIONS

    def residual_square(self, trials: Sequence[Trial], fit: Fit) -> float:
        """The same in the residual of fitted trials: projected off the model's parameters."""
        jacobian = fit.solution.jacobian[:, fit.solution.free]
        basis = np.linalg.qr(jacobian)[0]
        ends = np.cumsum([self.rows[t.name].shape[1] for t in trials])
        parts = np.split(basis, ends[:-1])
        imitated = sum(
            float(np.sum((self.rows[t.name] @ part) ** 2))
            for t, part in zip(trials, parts, strict=True)
        )
        return self.square(trials) - imitated / MOTIONS


@once_per_study
def gripper_log_error(prepared: PreparedStudy, fit: Fit) -> GripperLogError:
    """The `GripperLogError` of all trials, near a fitted model; 0 where one cannot be simulated."""
    trials = prepared.study.trials
    states = {name: values[None] for name, values in fit.initial_states.items()}
    white = prepared.all_white(trials, [fit.model], states)[0]
    parts = prepared.by_trial(trials, white)
    changes = {t.name: log_error_changes(prepared, fit, t, parts[t.name]) for t in trials}
    return GripperLogError({name: np.nan_to_num(rows, nan=0.0) for name, rows in changes.items()})


def log_error_changes(
    prepared: PreparedStudy, fit: Fit, trial: Trial, base: FloatArray
) -> FloatArray:
    """(motions, rows) change of a trial's whitened residual `base` for sampled gripper motions."""
    if trial.hand_drift is None and all(s.noise_std == 0.0 for s in trial.grip.splines):
        return np.zeros((MOTIONS, len(base)))
    motions = sampled_motions(trial.grip, GripperLogErrors(MOTIONS).of(trial))
    sampled = [replace(trial, name=f"{trial.name}/{i}", grip=m) for i, m in enumerate(motions)]
    initial_states = fit.initial_states.get(trial.name)
    states = {} if initial_states is None else {t.name: initial_states[None] for t in sampled}
    predicted = prepared.predict_all(sampled, [fit.model], states)
    return np.asarray(prepared.white(trial, np.concatenate(predicted)) - base)


@dataclass(frozen=True, eq=False)
class SystematicError:
    """Whitened changes of a fitted model's residuals by mesh error and gripper-log error.

    mesh   (rows,) to the residual of a simulation of twice the segments and half the step, less
           the error already subtracted from the study
    full_mesh  (rows,) the same without that subtraction; uncertain by the share `REMAINDER`
    gripper_motions  (motions, rows) by gripper motions sampled from the log's error model
    ends   (trials,) end of the rows of each trial
    """

    mesh: FloatArray
    full_mesh: FloatArray
    gripper_motions: FloatArray
    ends: NDArray[np.int_]

    def by_trial(self, rows: FloatArray) -> list[FloatArray]:
        """Parts (…, rows of a trial) of (…, rows), without the prior's rows, which come last."""
        return np.split(rows[..., : self.ends[-1]], self.ends[:-1], axis=-1)

    def variance(self, direction: FloatArray) -> float:
        """Variance beyond noise of residuals, corrected by `mesh`, along a direction (rows,).

        A finer mesh may still err by a share of its difference from the coarse one.
        """
        rows = direction[: self.ends[-1]]
        by_log = float(self.by_gripper_log(rows[None])[0, 0])
        return by_log + (REMAINDER * float(self.full_mesh @ rows)) ** 2

    def covariance(self, derivatives: FloatArray) -> FloatArray:
        """(p, p) covariance beyond noise of parameters; derivatives (p, rows) by residuals."""
        by_mesh = derivatives @ self.full_mesh  # subtracted given another model
        return np.asarray(self.by_gripper_log(derivatives) + np.outer(by_mesh, by_mesh))

    def by_gripper_log(self, derivatives: FloatArray) -> FloatArray:
        """(p, p) its part by gripper logs, whose errors are independent between trials."""
        pairs = zip(self.by_trial(self.gripper_motions), self.by_trial(derivatives), strict=True)
        shifts = [motions @ rows.T for motions, rows in pairs]
        return np.asarray(sum(m.T @ m for m in shifts) / MOTIONS)


def systematic_error(prepared: PreparedStudy, fit: Fit, trials: Sequence[Trial]) -> SystematicError:
    """The systematic error of a fitted model in these trials; 0 where it cannot be simulated."""
    initial_states = {name: values[None] for name, values in fit.initial_states.items()}
    white = prepared.all_white(trials, [fit.model], initial_states)[0]
    fine = finer(prepared).predict_all(trials, [fit.model], initial_states)
    difference = _rows(prepared, trials, fine) - white
    mesh = difference
    if prepared.mesh_m:
        subtracted = [prepared.mesh_m.get(t.name, 0.0) / (1.0 + REMAINDER) for t in trials]
        corrected = [points - error for points, error in zip(fine, subtracted, strict=True)]
        mesh = np.nan_to_num(_rows(prepared, trials, corrected) - white, nan=0.0)
    ends = np.cumsum([prepared.whiteners[t.name].rows for t in trials])
    rows = prepared.by_trial(trials, white)
    log_changes = [log_error_changes(prepared, fit, t, rows[t.name]) for t in trials]
    change = np.concatenate(log_changes, axis=1)
    difference = np.nan_to_num(difference, nan=0.0)
    mesh = mesh if prepared.mesh_m else difference
    return SystematicError(mesh, difference, np.nan_to_num(change, nan=0.0), ends)


def _rows(
    prepared: PreparedStudy, trials: Sequence[Trial], predicted_m: Sequence[FloatArray]
) -> FloatArray:
    """(rows,) whitened residuals of one model's predictions of trials."""
    pairs = zip(trials, predicted_m, strict=True)
    return np.concatenate([prepared.white(t, points)[0] for t, points in pairs])


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
