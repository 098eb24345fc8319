"""The hand's measured motion, made fit to drive the model: smoothed, placed where the camera saw it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from cell.cable.geometry import Motion

FloatArray = NDArray[np.float64]

#: A hand this close to where it began has not moved yet.
STILL_WITHIN_M = 1e-4
STILL_WITHIN_RAD = 2e-3


def smooth_motion(motion: Motion, bandwidth_s: float = 0.006) -> Motion:
    """Motion without the noise of its log, which the model would take for acceleration.

    Cubic smoothing splines whose equivalent kernel is `bandwidth_s` wide (an error of bandwidth⁴
    times the fourth derivative: 0.3 µm for 50 mm in 0.3 s).  A log sampled more coarsely than that
    is returned as it is.
    source  Silverman 1984, Ann. Statist. 12(3), eq. 1.3
    """
    interval_s = float(np.median(np.diff(motion.t_s)))
    if len(motion.t_s) < 5 or interval_s >= bandwidth_s:
        return motion
    roughness = bandwidth_s**4 / interval_s
    coordinates = (motion.x_m, motion.y_m, motion.angle_rad)
    values = make_smoothing_spline(
        motion.t_s, np.column_stack(coordinates), lam=roughness, axis=0
    )(motion.t_s)
    return Motion(motion.t_s, *(np.ascontiguousarray(v) for v in values.T))


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
