"""Predicted frames of a hold: simulated before its last frame has arrived."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import STILL, Motion, away_from
from cell.cable.solver import Solver
from cell.identify.gripper_errors import GripperLogErrors, sampled_motions
from cell.identify.parameters import ParameterSpace, difference_points
from cell.study.data import Trial

#: Largest difference between a frame's time and its predicted time, s.
MOST_OFF_S = 1e-3


@dataclass(frozen=True, eq=False)
class PredictedFrames:
    """Predicted markers in all frames of a hold, for a cable and its finite-difference neighbours.

    grip       motion of the gripper so far, and then held
    t_s        (T,) of the frames, those to come included
    lanes      (1 + p, p) fit coordinates: the cable, and its neighbours for finite differences
    markers_m  (1 + p, T, markers, 2)
    others_m   (samples, T, markers, 2) of the cable for sampled motions of the gripper
    """

    grip: Motion
    t_s: FloatArray
    lanes: FloatArray
    markers_m: FloatArray
    others_m: FloatArray

    def as_filmed(self, trial: Trial) -> PredictedFrames | None:
        """The same at the frames' actual times and with the gripper at its detected pose.

        To first order in the frames' delay.
        returns  None if the actual hold differs from the predicted one
        """
        if trial.markers.t_s.shape != self.t_s.shape:
            return None
        late_s = trial.markers.t_s - self.t_s
        if np.abs(late_s).max() > MOST_OFF_S or not _same_motion(trial.grip, self.grip):
            return None
        shift_m = [trial.grip.x_m[0] - self.grip.x_m[0], trial.grip.y_m[0] - self.grip.y_m[0]]
        markers_m, others_m = (
            _later(markers_m, self.t_s, late_s, np.array(shift_m))
            for markers_m in (self.markers_m, self.others_m)
        )
        return PredictedFrames(trial.grip, trial.markers.t_s, self.lanes, markers_m, others_m)


@njit(cache=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _later(
    markers_m: FloatArray, t_s: FloatArray, late_s: FloatArray, shift_m: FloatArray
) -> FloatArray:
    """(lanes, T, markers, 2) markers delayed by (T,) and shifted by (2,), to first order.

    Compiled, as numpy's gradient took a third of the time between the last frame and the result.
    """
    out = np.empty_like(markers_m)
    lanes, frames, markers, _ = markers_m.shape
    for t in range(frames):
        before, after = max(t - 1, 0), min(t + 1, frames - 1)
        # derivative of the parabola through the neighbours; one-sided at the ends
        h, k = t_s[t] - t_s[before], t_s[after] - t_s[t]
        back = late_s[t] * (k / (h * (h + k)) if before < t < after else (before < t) / (h + k))
        on = late_s[t] * (h / (k * (h + k)) if before < t < after else (t < after) / (h + k))
        for lane in range(lanes):
            for m in range(markers):
                for c in range(2):
                    here = markers_m[lane, t, m, c]
                    rise = back * (here - markers_m[lane, before, m, c])
                    rise += on * (markers_m[lane, after, m, c] - here)
                    out[lane, t, m, c] = here + rise + shift_m[c]
    return out


def _same_motion(motion: Motion, predicted: Motion) -> bool:
    for name, limit in STILL.items():
        expected = np.interp(motion.t_s, predicted.t_s, getattr(predicted, name))
        if np.abs(getattr(motion, name) - expected).max() > limit:
            return False
    return True


def extended_at_rest(motion: Motion, until_s: float) -> Motion:
    """The log extended to `until_s` by its rest, played back and forth, so that noise continues.

    Only the later half of the rest: in the first one the gripper still settles.
    """
    interval_s = float(motion.t_s[-1] - motion.t_s[0]) / (len(motion.t_s) - 1)
    more = int(np.ceil((until_s - float(motion.t_s[-1])) / interval_s))
    if more <= 0:
        return motion
    moved = away_from(motion, slice(-10, None))
    count = int(np.argmax(moved[::-1])) if moved.any() else len(moved)
    back = len(moved) - 1 - np.arange(max(1, count // 2))
    again = np.resize(np.concatenate([back, back[::-1]]), more)
    return Motion(
        np.concatenate([motion.t_s, motion.t_s[-1] + interval_s * np.arange(1, more + 1)]),
        *(np.concatenate([v, v[again]]) for v in (motion.x_m, motion.y_m, motion.angle_rad)),
    )


def simulate_frames(
    trial: Trial,
    t_s: FloatArray,
    arc_length_m: FloatArray,
    space: ParameterSpace,
    mean: FloatArray,
    *,
    solver: Solver,
    hand: GripperLogErrors,
) -> PredictedFrames:
    """Simulate a hold to its end, the gripper staying where it is.

    trial         the frames filmed so far
    t_s           (T,) of all its frames, those to come included, increasing
    arc_length_m  (markers,) from the gripping point, m
    mean          (p,) current estimate of the fit coordinates
    raises        as the engine
    """
    grip = extended_at_rest(trial.grip, float(t_s[-1]))
    lanes = difference_points(mean, space.difference_steps(mean))
    others = sampled_motions(grip, hand)
    models = [space.model(q) for q in lanes]
    markers_m = simulate(
        models + models[:1] * len(others),
        [grip] * len(models) + others,
        t_s,
        arc_length_m,
        solver=solver,
        start=trial.start,
        release_s=trial.release_s,
    )
    count = len(models)
    return PredictedFrames(grip, t_s, lanes, markers_m[:count], markers_m[count:])
