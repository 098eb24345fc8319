"""The gripper's motion: its alignment with the camera, and samples of its log's error."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.clamp import motions_like
from cell.cable.geometry import Motion
from cell.study.data import Trial
from cell.study.hand_drift import HandDrift


def align_motion(
    motion: Motion, t_s: FloatArray, grip_m: FloatArray, clamp_angle_rad: FloatArray
) -> Motion:
    """Motion shifted by constants to where the camera sees the gripping point and the clamp.

    t_s              (T,) times of the frames, s
    grip_m           (T, 2) gripping point in the frames, m; nan where the jaw is not detected
    clamp_angle_rad  (T,) clamp angle in the frames, rad; nan likewise
    returns          motion plus the medians of (detected − logged); unchanged without detection
    """
    detected = np.isfinite(clamp_angle_rad) & np.isfinite(grip_m).all(-1)
    if not detected.any():
        return motion
    shifted = []
    for logged, camera in (
        (motion.x_m, grip_m[detected, 0]),
        (motion.y_m, grip_m[detected, 1]),
        (motion.angle_rad, clamp_angle_rad[detected]),
    ):
        shifted.append(logged + np.median(camera - np.interp(t_s[detected], motion.t_s, logged)))
    return Motion(motion.t_s, *shifted)


@dataclass(frozen=True)
class GripperLogErrors:
    """Uncertainty of the gripper's motion beyond the noise estimated from its log.

    samples       random motions that propagate it to the parameters; 0 = the log is exact
    offset_m      standard deviation of a constant error of the gripping point along x and y
    offset_rad    likewise of the clamp angle
    drift         error of an integrated position; None = it was not integrated
    """

    samples: int = 15
    offset_m: float = 0.0
    offset_rad: float = 0.0
    drift: HandDrift | None = None

    def of(self, trial: Trial) -> GripperLogErrors:
        """The same for a trial's gripper, which may have a drift of its own."""
        return replace(self, drift=trial.hand_drift)


def sampled_motions(motion: Motion, errors: GripperLogErrors, first: int = 0) -> list[Motion]:
    """`errors.samples` random motions that are as likely as the logged one.

    A longer log has the same noise on its first samples.

    first   index of the first sample; it seeds the noise
    source  parametric bootstrap: noise of the size that the engine's splines estimate in the log is
            drawn again and added to the smoothed log
    """
    splines = motion.splines
    smooth = [spline(motion.t_s) for spline in splines]
    offsets = (errors.offset_m, errors.offset_m, errors.offset_rad)
    drawn = np.empty((errors.samples, len(splines), len(motion.t_s)))
    for sample in range(errors.samples):
        for axis, (value, spline, offset) in enumerate(zip(smooth, splines, offsets, strict=True)):
            rng = np.random.default_rng([20260101, first + sample, axis])
            constant = offset * rng.normal()
            noise = spline.noise_std * rng.normal(size=len(value))
            drawn[sample, axis] = value + constant + noise
    if errors.drift is not None:
        for sample in range(errors.samples):
            rng = np.random.default_rng([20260102, first + sample])
            drawn[sample] += _drifted(motion, errors.drift, rng)
    return motions_like(motion, drawn)


def _drifted(motion: Motion, drift: HandDrift, rng: np.random.Generator) -> FloatArray:
    """(3, T) a random drift of x, y and angle."""
    shapes_m, turns_rad = drift.shapes_m(motion.t_s, motion), drift.turns_rad(motion.t_s)
    place_m = np.einsum("k,ktc->ct", rng.normal(size=len(shapes_m)), shapes_m)
    turn = rng.normal(size=len(turns_rad)) @ turns_rad
    hand_m = np.column_stack([motion.x_m, motion.y_m])
    place_m = place_m + drift.turned_m(turn, hand_m).T
    return np.vstack([place_m, turn[None] if drift.clamp_turns else 0.0 * turn[None]])
