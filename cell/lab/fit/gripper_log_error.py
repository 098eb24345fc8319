"""Errors of the gripper log, as changes of the residuals of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.identify.gripper_errors import GripperLogErrors, sampled_motions
from cell.lab.data.prepared import PreparedStudy, once_per_study
from cell.lab.fit.fitting import Fit
from cell.study.data import Trial

#: Motions of the gripper drawn for every trial.
MOTIONS = 8


@dataclass(frozen=True, eq=False)
class GripperLogError:
    """Whitened changes of residuals by motions of the gripper that are as likely as its log.

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
    """Of every trial, near a fitted model.  What cannot be simulated counts as none."""
    trials = prepared.study.trials
    states = {name: values[None] for name, values in fit.initial_states.items()}
    here = prepared.all_white(trials, [fit.model], states)[0]
    parts = prepared.by_trial(trials, here)
    changes = {t.name: by_other_hands(prepared, fit, t, parts[t.name]) for t in trials}
    return GripperLogError({name: np.nan_to_num(rows, nan=0.0) for name, rows in changes.items()})


def by_other_hands(prepared: PreparedStudy, fit: Fit, trial: Trial, here: FloatArray) -> FloatArray:
    """(motions, rows) change from `here`, a trial's whitened residual, by other hands' motions."""
    if trial.hand_drift is None and all(s.noise_std == 0.0 for s in trial.grip.splines):
        return np.zeros((MOTIONS, len(here)))
    motions = sampled_motions(trial.grip, GripperLogErrors(MOTIONS).of(trial))
    others = [replace(trial, name=f"{trial.name}/{i}", grip=m) for i, m in enumerate(motions)]
    initial_states = fit.initial_states.get(trial.name)
    known = {} if initial_states is None else {t.name: initial_states[None] for t in others}
    predicted = prepared.predict_all(others, [fit.model], known)
    return np.asarray(prepared.white(trial, np.concatenate(predicted)) - here)
