"""The hand's measured motion: where the camera saw it, when it begins, how far it may be wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.clamp import motion_splines, motions_like
from cell.cable.geometry import Motion

FloatArray = NDArray[np.float64]

#: A hand this close to where it began has not moved yet.
STILL_WITHIN_M = 1e-4
STILL_WITHIN_RAD = 2e-3


def align_motion(
    motion: Motion, t_s: FloatArray, grip_m: FloatArray, clamp_angle_rad: FloatArray
) -> Motion:
    """Motion shifted by constants to where the camera sees the gripping point and the clamp.

    t_s              (T,) times of the frames, s
    grip_m           (T, 2) gripping point in the frames, m; nan where the jaw was not found
    clamp_angle_rad  (T,) clamp angle in the frames, rad; nan likewise
    returns          motion plus the medians of (seen − logged); unchanged if the jaw was never seen
    """
    seen = np.isfinite(clamp_angle_rad) & np.isfinite(grip_m).all(-1)
    if not seen.any():
        return motion
    shifted = []
    for logged, camera in (
        (motion.x_m, grip_m[seen, 0]),
        (motion.y_m, grip_m[seen, 1]),
        (motion.angle_rad, clamp_angle_rad[seen]),
    ):
        shifted.append(logged + np.median(camera - np.interp(t_s[seen], motion.t_s, logged)))
    return Motion(motion.t_s, *shifted)


def moves_from_s(motion: Motion) -> float:
    """Time at which the hand first leaves where it began, s; `inf` if it never does."""
    first = slice(0, max(1, min(10, len(motion.t_s) // 10)))
    away = np.zeros(len(motion.t_s), dtype=bool)
    for value, limit in (
        (motion.x_m, STILL_WITHIN_M),
        (motion.y_m, STILL_WITHIN_M),
        (motion.angle_rad, STILL_WITHIN_RAD),
    ):
        away |= np.abs(value - np.median(value[first])) > limit
    return float(motion.t_s[away.argmax()]) if away.any() else float("inf")


@dataclass(frozen=True)
class HandErrors:
    """Uncertainty of the hand's motion beyond the noise found in its log.

    samples       motions drawn to see what it does to the parameters; 0 = taken as exact
    offset_m      standard deviation of a constant error of the gripping point along x and y
    offset_rad    likewise of the clamp angle
    """

    samples: int = 15
    offset_m: float = 0.0
    offset_rad: float = 0.0


def likely_motions(motion: Motion, errors: HandErrors) -> list[Motion]:
    """`errors.samples` motions as likely as the logged one.

    The noise is the same on the same samples of a log that goes on longer.
    source  parametric bootstrap: the noise that the engine's splines find in the log and take out,
            drawn anew, for them to take out again, as much as in the log
    """
    splines = motion_splines(motion)
    smooth = [spline(motion.t_s) for spline in splines]
    offsets = (errors.offset_m, errors.offset_m, errors.offset_rad)
    drawn = np.empty((errors.samples, len(splines), len(motion.t_s)))
    for sample in range(errors.samples):
        for axis, (value, spline, offset) in enumerate(zip(smooth, splines, offsets, strict=True)):
            rng = np.random.default_rng([20260101, sample, axis])
            constant = offset * rng.normal()
            noise = spline.noise_std * rng.normal(size=len(value))
            drawn[sample, axis] = value + constant + noise
    return motions_like(motion, drawn)
