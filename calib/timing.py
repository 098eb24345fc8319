"""Estimates the camera's latency and the arm's lag separately, from one filmed motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit as student_quantile

from calib.errors import MisfitError, OneSidedError, TooFewError
from calib.robust import sum_variance
from drivers.interfaces import FloatArray, Trajectory
from drivers.servo import servo_response

#: Fewest frames, and least speed reached in the motion.
LEAST_FRAMES, LEAST_SPEED_M_PER_S = 30, 0.05
#: Seen and reported gripper may differ by this much, rms, once shift and delay are allowed for, m.
MOST_MISFIT_M = 0.0003
#: Longest delays that are looked for, s: a USB camera's stamps are up to 0.9 s beside the clock.
_LONGEST_S, _LONGEST_LAG_S = 1.0, 0.5
_SMOOTHED_S, _GRID_S = 0.04, 0.01
#: Apart so far are two delays of which the difference is taken; steps without a search, s.
_APART_S, _STRIDE_S, _SETTLED_S, _STEPS = 2e-4, 0.02, 1e-7, 12


@dataclass(frozen=True)
class Delay:
    """A delay, s, half the width of its 95 % interval, s, and the rms residual at it, m."""

    value_s: float
    half_width_s: float
    rms_m: float


def camera_latency(stamps_s: FloatArray, detected_m: FloatArray, gripper_log: Trajectory) -> Delay:
    """Latency of the camera's time stamps: how late they are on the cell's clock.

    stamps_s  (N,) of frames
    detected_m  (N, 2) gripping point as the camera sees it
    gripper_log  measured poses, times on the cell's clock, from before the first to after the last
    raises    TooFewError, OneSidedError, MisfitError
    """
    keep = np.all(np.isfinite(detected_m), axis=1)
    stamps_s, detected_m = stamps_s[keep], detected_m[keep]
    if len(stamps_s) < LEAST_FRAMES:
        raise TooFewError(
            f"the jaw was found in {len(stamps_s)} of at least {LEAST_FRAMES} frames",
            "see that its marks are lit and in the picture during the whole motion",
        )
    _check_speed(gripper_log)
    told = _smooth(np.stack([gripper_log.x_m, gripper_log.y_m], axis=1), gripper_log.t_s)

    def left(delay_s: float) -> FloatArray:
        said = _at(gripper_log.t_s, told, stamps_s - delay_s)
        off = detected_m - said
        return np.asarray(off - off.mean(axis=0), dtype=np.float64)

    return _delay(left, -_LONGEST_S, _LONGEST_S, "camera")


def arm_lag(commanded: Trajectory, gripper_log: Trajectory) -> Delay:
    """Lag of the arm behind the commanded path, as modelled by `servo_response`.

    commanded  path as commanded, times on the cell's clock
    gripper_log  measured poses of the same time
    raises  OneSidedError, MisfitError
    """
    _check_speed(gripper_log)
    return _delay(_lag_residuals(commanded, gripper_log), 0.0, _LONGEST_LAG_S, "arm")


def _lag_residuals(commanded: Trajectory, gripper_log: Trajectory) -> Callable[[float], FloatArray]:
    """What a lag, s, leaves: (N, 2) m."""
    start = gripper_log.at(float(commanded.t_s[0]))
    measured = np.stack([gripper_log.x_m, gripper_log.y_m], axis=1)
    keep = gripper_log.t_s >= commanded.t_s[0]

    def left(lag_s: float) -> FloatArray:
        if lag_s < 0.0:  # no arm has such a lag; continued evenly, so that 0 has a slope
            return np.asarray(2.0 * left(0.0) - left(-lag_s))
        meant = servo_response(commanded, lag_s, start=start)
        path = np.stack([meant.x_m, meant.y_m], axis=1)
        return np.asarray(measured[keep] - _at(meant.t_s, path, gripper_log.t_s[keep]))

    return left


def latency_change(stamps_s: FloatArray, detected_m: FloatArray, gripper_log: Trajectory) -> Delay:
    """Remaining latency of stamps that were corrected for latency: near 0, without a search.

    Takes milliseconds; what it takes and raises is that of `camera_latency`, but for misfits.
    """
    keep = np.all(np.isfinite(detected_m), axis=1)
    stamps_s, detected_m = stamps_s[keep], detected_m[keep]
    if len(stamps_s) < LEAST_FRAMES:
        raise TooFewError(f"the jaw was found in {len(stamps_s)} frames", "light its marks")
    said = np.stack([gripper_log.x_m, gripper_log.y_m], axis=1)

    def left(delay_s: float) -> FloatArray:
        off = detected_m - _at(gripper_log.t_s, said, stamps_s - delay_s)
        return np.asarray(off - off.mean(axis=0), dtype=np.float64)

    return _nearby(left, 0.0)


def lag_change(commanded: Trajectory, gripper_log: Trajectory, lag_s: float) -> Delay:
    """Change of the arm's lag from `lag_s`, without a search; see `arm_lag`."""
    left = _lag_residuals(commanded, gripper_log)
    found = _nearby(left, lag_s)
    return replace(found, value_s=found.value_s - lag_s)


def _nearby(residuals: Callable[[float], FloatArray], start_s: float) -> Delay:
    """Delay of least squares by Gauss and Newton from a start, and its interval."""
    value_s = start_s
    for _ in range(_STEPS):
        slope, rest = _slope(residuals, value_s), residuals(value_s)
        step_s = -float(np.sum(slope * rest)) / max(float(np.sum(slope**2)), 1e-30)
        value_s = max(value_s + float(np.clip(step_s, -_STRIDE_S, _STRIDE_S)), start_s - _LONGEST_S)
        if abs(step_s) < _SETTLED_S:
            break
    return _with_interval(residuals, value_s)


def _delay(residuals: Callable[[float], FloatArray], low_s: float, high_s: float, of: str) -> Delay:
    """Delay of least squares, its interval allowing for residuals that go together in time."""
    grid = np.linspace(low_s, high_s, round((high_s - low_s) / _GRID_S) + 1)
    costs = [float(np.sum(residuals(s) ** 2)) for s in grid]
    at = int(np.argmin(costs))
    none = MisfitError(
        f"{of}: no delay within {low_s:g} … {high_s:g} s explains the motion",
        "check the clocks of camera and robot",
    )
    # no delay is shorter than 0, so one next to it is nothing odd
    if at == len(grid) - 1 or (at == 0 and low_s != 0.0):
        raise none
    delay = _nearby(residuals, float(grid[at]))
    if delay.value_s < low_s - delay.half_width_s:
        raise none
    delay = replace(delay, value_s=max(low_s, delay.value_s))
    if delay.rms_m > MOST_MISFIT_M:
        raise MisfitError(
            f"{of}: gripper as seen and as told still differ by {delay.rms_m * 1e3:.2f} mm rms, "
            f"allowed {MOST_MISFIT_M * 1e3:g} mm",
            "calibrate the cell first; check payload and mounting, and that the camera is tight",
        )
    return delay


def _slope(residuals: Callable[[float], FloatArray], value_s: float) -> FloatArray:
    return (residuals(value_s + _APART_S) - residuals(value_s - _APART_S)) / (2.0 * _APART_S)


def _with_interval(residuals: Callable[[float], FloatArray], value_s: float) -> Delay:
    """A delay with its interval, which allows for residuals that go together in time."""
    rest, slope = residuals(value_s), _slope(residuals, value_s)
    rms = float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))
    score = np.sum(slope * rest, axis=1)
    total = sum_variance(score)
    information = float(np.sum(slope**2))
    white = float(np.sum(rest**2)) / (rest.size - 3) * information
    spread_s = np.sqrt(max(total, white)) / information
    return Delay(value_s, float(student_quantile(max(5, len(score) // 4), 0.975) * spread_s), rms)


def _smooth(values: FloatArray, t_s: FloatArray) -> FloatArray:
    """Measured poses without their noise, which would favour delays at which frames fall between.

    source  Savitzky & Golay 1964: cubics over `_SMOOTHED_S`
    """
    from scipy.signal import savgol_filter  # half a second, of which only a calibration has need

    count = 2 * round(0.5 * _SMOOTHED_S / float(np.median(np.diff(t_s)))) + 1
    if count < 5 or len(values) < count:
        return values
    return np.asarray(savgol_filter(values, count, 3, axis=0), dtype=np.float64)


def _at(t_s: FloatArray, values: FloatArray, when_s: FloatArray) -> FloatArray:
    return np.stack([np.interp(when_s, t_s, v) for v in values.T], axis=1)


def _check_speed(gripper_log: Trajectory) -> None:
    t_s = np.arange(gripper_log.t_s[0], gripper_log.t_s[-1], 0.02)
    places = _at(gripper_log.t_s, np.stack([gripper_log.x_m, gripper_log.y_m], axis=1), t_s)
    speed = float(np.linalg.norm(np.diff(places, axis=0), axis=1).max(initial=0.0) / 0.02)
    if speed < LEAST_SPEED_M_PER_S:
        raise OneSidedError(
            f"the gripper moved at {speed:.3f} m/s at most, {LEAST_SPEED_M_PER_S} m/s are needed",
            "raise limits.velocity_m_per_s, or take the slider to 100 %",
        )
