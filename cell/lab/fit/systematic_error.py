"""Errors of a simulation and of the gripper log, in addition to the noise of the markers.

With many frames an effect shows that moves a marker by a thousandth of the noise: far less than the
mesh and the step of a simulation, or ten micrometres of noise in the gripper log, do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.corrections import LEFT, finer
from cell.lab.fit.fitting import Fit
from cell.lab.fit.gripper_log_error import MOTIONS, by_other_hands
from cell.study.data import Trial


@dataclass(frozen=True, eq=False)
class SystematicError:
    """Whitened changes of a fitted model's residuals by these errors.

    mesh   (rows,) to what a simulation of twice the segments and half the step leaves, beyond what
           has been taken out of the study
    doubt  (rows,) the same whether taken out or not: a share `LEFT` of it may still be wrong
    hands  (motions, rows) by other motions of the gripper, as likely as its log
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
    """Of a model fitted to trials, at its parameters.  What cannot be simulated counts as none."""
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
