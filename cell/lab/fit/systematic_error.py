"""Errors of a simulation and of the gripper log, in addition to the noise of the markers.

With many frames an effect shows that moves a marker by a thousandth of the noise: far less than the
mesh and the step of a simulation, or ten micrometres of noise in the gripper log, do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.identify.gripper_errors import GripperLogErrors, sampled_motions
from cell.lab.data.prepared import PreparedStudy, once_per_study
from cell.lab.fit.corrections import LEFT, finer
from cell.lab.fit.fitting import Fit
from cell.study.data import Trial

#: Motions of the gripper drawn for every trial.
MOTIONS = 8


@dataclass(frozen=True, eq=False)
class GripperLogError:
    """Whitened changes of residuals for sampled gripper motions that are as likely as the log.

    rows  per trial (motions, rows)
    """

    rows: Mapping[str, FloatArray]

    def inflation(self, changes: Mapping[str, FloatArray]) -> float:
        """Variance of residuals along a direction, over that by noise alone; 1 or more.

        A χ² of noise and log together is so many times that of noise: what one effect more
        explains along this direction is worth as much less.
        changes  per trial (rows,): the direction
        """
        size = sum(float(change @ change) for change in changes.values())
        if not (np.isfinite(size) and size > 0.0):
            return 1.0
        by_hand = sum(
            float(np.sum((self.rows[name] @ change) ** 2)) for name, change in changes.items()
        )
        return 1.0 + by_hand / (MOTIONS * size)

    def square(self, trials: Sequence[Trial]) -> float:
        """Expected χ² that the log's error adds in trials."""
        return sum(float(np.sum(self.rows[t.name] ** 2)) for t in trials) / MOTIONS

    def residual_square(self, trials: Sequence[Trial], fit: Fit) -> float:
        """The same of trials that a model was fitted to: less what its parameters imitate."""
        slopes = fit.solution.jacobian[:, fit.solution.free]
        basis = np.linalg.qr(slopes)[0]
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
    here = prepared.all_white(trials, [fit.model], states)[0]
    parts = prepared.by_trial(trials, here)
    changes = {t.name: by_other_hands(prepared, fit, t, parts[t.name]) for t in trials}
    return GripperLogError({name: np.nan_to_num(rows, nan=0.0) for name, rows in changes.items()})


def by_other_hands(prepared: PreparedStudy, fit: Fit, trial: Trial, here: FloatArray) -> FloatArray:
    """(motions, rows) change of a trial's whitened residual `here` for sampled gripper motions."""
    if trial.hand_drift is None and all(s.noise_std == 0.0 for s in trial.grip.splines):
        return np.zeros((MOTIONS, len(here)))
    motions = sampled_motions(trial.grip, GripperLogErrors(MOTIONS).of(trial))
    others = [replace(trial, name=f"{trial.name}/{i}", grip=m) for i, m in enumerate(motions)]
    initial_states = fit.initial_states.get(trial.name)
    known = {} if initial_states is None else {t.name: initial_states[None] for t in others}
    predicted = prepared.predict_all(others, [fit.model], known)
    return np.asarray(prepared.white(trial, np.concatenate(predicted)) - here)


@dataclass(frozen=True, eq=False)
class SystematicError:
    """Whitened changes of a fitted model's residuals by mesh error and gripper-log error.

    mesh   (rows,) to what a simulation of twice the segments and half the step leaves, beyond what
           has been taken out of the study
    doubt  (rows,) the same whether taken out or not: a share `LEFT` of it may still be wrong
    gripper_motions  (motions, rows) by other motions of the gripper, as likely as its log
    ends   (trials,) where the rows of each trial end
    """

    mesh: FloatArray
    doubt: FloatArray
    gripper_motions: FloatArray
    ends: NDArray[np.int_]

    def by_trial(self, rows: FloatArray) -> list[FloatArray]:
        """Parts (…, rows of a trial) of (…, rows); the prior's rows, which come last, left out."""
        return np.split(rows[..., : self.ends[-1]], self.ends[:-1], axis=-1)

    def variance(self, left: FloatArray) -> float:
        """Of the projection of residuals moved by `mesh` on `left` (rows,), beyond that by noise.

        A finer mesh may still err by a share of what it differs by.
        """
        rows = left[: self.ends[-1]]
        by_hand = float(self.by_hand(rows[None])[0, 0])
        return by_hand + (LEFT * float(self.doubt @ rows)) ** 2

    def covariance(self, answer: FloatArray) -> FloatArray:
        """(p, p) of what residuals as they are answer by `answer` (p, rows) beyond noise."""
        by_mesh = answer @ self.doubt  # taken out by another model it may be all wrong
        return np.asarray(self.by_hand(answer) + np.outer(by_mesh, by_mesh))

    def by_hand(self, answer: FloatArray) -> FloatArray:
        """(p, p) the hands' share of it: each trial's is wrong in its own way."""
        pairs = zip(self.by_trial(self.gripper_motions), self.by_trial(answer), strict=True)
        moved = [hands @ rows.T for hands, rows in pairs]
        return np.asarray(sum(m.T @ m for m in moved) / MOTIONS)


def systematic_error(prepared: PreparedStudy, fit: Fit, trials: Sequence[Trial]) -> SystematicError:
    """The systematic error of a fitted model in these trials; 0 where it cannot be simulated."""
    initial_states = {name: values[None] for name, values in fit.initial_states.items()}
    here = prepared.all_white(trials, [fit.model], initial_states)[0]
    fine = finer(prepared).predict_all(trials, [fit.model], initial_states)
    doubt = _rows(prepared, trials, fine) - here
    mesh = doubt
    if prepared.mesh_m:
        known = [prepared.mesh_m.get(t.name, 0.0) / (1.0 + LEFT) for t in trials]
        taken = [points - error for points, error in zip(fine, known, strict=True)]
        mesh = np.nan_to_num(_rows(prepared, trials, taken) - here, nan=0.0)
    ends = np.cumsum([prepared.whiteners[t.name].rows for t in trials])
    rows = prepared.by_trial(trials, here)
    hands = [by_other_hands(prepared, fit, t, rows[t.name]) for t in trials]
    change = np.concatenate(hands, axis=1)
    doubt = np.nan_to_num(doubt, nan=0.0)
    mesh = mesh if prepared.mesh_m else doubt
    return SystematicError(mesh, doubt, np.nan_to_num(change, nan=0.0), ends)


def _rows(
    prepared: PreparedStudy, trials: Sequence[Trial], predicted_m: Sequence[FloatArray]
) -> FloatArray:
    """(rows,) whitened residuals of what one model predicts of trials."""
    pairs = zip(trials, predicted_m, strict=True)
    return np.concatenate([prepared.white(t, points)[0] for t, points in pairs])
