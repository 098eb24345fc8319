"""The hand's measured motion: where the camera saw it, when it begins, how far it may be wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.clamp import motion_splines
from cell.cable.geometry import Motion

FloatArray = NDArray[np.float64]

#: A hand this close to where it began has not moved yet.
STILL_WITHIN_M = 1e-4
STILL_WITHIN_RAD = 2e-3

_SETTLING_S = 0.04


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


def quiet_motion(motion: Motion) -> Motion:
    """The motion without its log's noise: smooth while it moves, still where it rests.

    A rest is a beginning or an end that stays within the log's noise of its mean; `_SETTLING_S`
    next to the motion is left to the smoothing, for an arm does not stop at once.
    """
    quiet = []
    for spline in motion_splines(motion):
        value = spline(motion.t_s)
        if spline.noise_std > 0.0:
            value = _at_rest(motion.t_s, value, spline.noise_std)
            value = _at_rest(-motion.t_s[::-1], value[::-1], spline.noise_std)[::-1]
        quiet.append(np.ascontiguousarray(value))
    return Motion(motion.t_s, *quiet)


def _at_rest(t_s: FloatArray, value: FloatArray, noise_std: float) -> FloatArray:
    """Value with its resting beginning, if any, replaced by its mean, and blended over."""
    first = np.searchsorted(t_s, t_s[0] + _SETTLING_S, side="right")
    away = np.abs(value - np.mean(value[:first])) > 2.0 * noise_std
    until_s = (t_s[away.argmax()] if away.any() else t_s[-1] + 2.0 * _SETTLING_S) - _SETTLING_S
    rests = t_s < until_s
    if not rests.any():
        return value
    kept = np.clip((t_s - until_s) / (0.5 * _SETTLING_S) + 1.0, 0.0, 1.0)
    kept = kept * kept * (3.0 - 2.0 * kept)
    mean = np.mean(value[rests])
    return np.asarray(mean + kept * (value - mean))


def likely_motions(motion: Motion, errors: HandErrors) -> list[Motion]:
    """`quiet_motion`, then `errors.samples` others as likely as it.

    source  parametric bootstrap: the noise found in the log, drawn anew and taken out again
    """
    rng = np.random.default_rng(20260101)
    quiet = quiet_motion(motion)
    splines = motion_splines(motion)
    values = (quiet.x_m, quiet.y_m, quiet.angle_rad)
    offsets = (errors.offset_m, errors.offset_m, errors.offset_rad)
    motions = [quiet]
    for _ in range(errors.samples):
        drawn = [
            value + spline.noise_std * rng.normal(size=len(value)) + offset * rng.normal()
            for value, spline, offset in zip(values, splines, offsets, strict=True)
        ]
        motions.append(quiet_motion(Motion(motion.t_s, *drawn)))
    return motions
