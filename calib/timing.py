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
#: Largest rms difference of detected and logged gripper after correction of shift and delay, m.
MOST_MISFIT_M = 0.0003
#: Longest delays in the search, s: a USB camera's stamps are up to 0.9 s off the clock.
_LONGEST_S, _LONGEST_LAG_S = 1.0, 0.5
_SMOOTHED_S, _GRID_S = 0.04, 0.01
#: Half step of the finite difference, largest step and tolerance of Gauss–Newton, s; most steps.
_APART_S, _STRIDE_S, _CONVERGED_S, _STEPS = 2e-4, 0.02, 1e-7, 12


@dataclass(frozen=True)
class Delay:
    """A delay, s, half the width of its 95 % interval, s, and the rms residual at it, m."""

    value_s: float
    half_width_s: float
    rms_m: float


def camera_latency(stamps_s: FloatArray, detected_m: FloatArray, gripper_log: Trajectory) -> Delay:
    """Latency of the camera's time stamps: how late they are on the cell's clock.

    stamps_s  (N,) of frames
    detected_m  (N, 2) gripping point as detected by the camera
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
    logged_m = _smooth(np.stack([gripper_log.x_m, gripper_log.y_m], axis=1), gripper_log.t_s)

    def residuals(delay_s: float) -> FloatArray:
        expected_m = _at(gripper_log.t_s, logged_m, stamps_s - delay_s)
        difference_m = detected_m - expected_m
        return np.asarray(difference_m - difference_m.mean(axis=0), dtype=np.float64)

    return _delay(residuals, -_LONGEST_S, _LONGEST_S, "camera")


def arm_lag(commanded: Trajectory, gripper_log: Trajectory) -> Delay:
    """Lag of the arm behind the commanded path, as modelled by `servo_response`.

    commanded  path as commanded, times on the cell's clock
    gripper_log  measured poses of the same time
    raises  OneSidedError, MisfitError
    """
    _check_speed(gripper_log)
    return _delay(_lag_residuals(commanded, gripper_log), 0.0, _LONGEST_LAG_S, "arm")


def _lag_residuals(commanded: Trajectory, gripper_log: Trajectory) -> Callable[[float], FloatArray]:
    """Function from a lag, s, to its residuals (N, 2), m."""
    start = gripper_log.at(float(commanded.t_s[0]))
    measured = np.stack([gripper_log.x_m, gripper_log.y_m], axis=1)
    keep = gripper_log.t_s >= commanded.t_s[0]

    def residuals(lag_s: float) -> FloatArray:
        if lag_s < 0.0:  # impossible, but continued symmetrically for the derivative at 0
            return np.asarray(2.0 * residuals(0.0) - residuals(-lag_s))
        response = servo_response(commanded, lag_s, start=start)
        path = np.stack([response.x_m, response.y_m], axis=1)
        return np.asarray(measured[keep] - _at(response.t_s, path, gripper_log.t_s[keep]))

    return residuals


def latency_change(stamps_s: FloatArray, detected_m: FloatArray, gripper_log: Trajectory) -> Delay:
    """Remaining latency of stamps that were corrected for latency: near 0, without a search.

    It runs in milliseconds; arguments and errors as `camera_latency`, without MisfitError.
    """
    keep = np.all(np.isfinite(detected_m), axis=1)
    stamps_s, detected_m = stamps_s[keep], detected_m[keep]
    if len(stamps_s) < LEAST_FRAMES:
        raise TooFewError(f"the jaw was found in {len(stamps_s)} frames", "light its marks")
    logged_m = np.stack([gripper_log.x_m, gripper_log.y_m], axis=1)

    def residuals(delay_s: float) -> FloatArray:
        difference_m = detected_m - _at(gripper_log.t_s, logged_m, stamps_s - delay_s)
        return np.asarray(difference_m - difference_m.mean(axis=0), dtype=np.float64)

    return _gauss_newton(residuals, 0.0)


def lag_change(commanded: Trajectory, gripper_log: Trajectory, lag_s: float) -> Delay:
    """Change of the arm's lag from `lag_s`, without a search; see `arm_lag`."""
    residuals = _lag_residuals(commanded, gripper_log)
    delay = _gauss_newton(residuals, lag_s)
    return replace(delay, value_s=delay.value_s - lag_s)


def _gauss_newton(residuals: Callable[[float], FloatArray], start_s: float) -> Delay:
    """Delay of least squares by Gauss–Newton from a start, and its interval."""
    value_s = start_s
    for _ in range(_STEPS):
        derivative, residual = _slope(residuals, value_s), residuals(value_s)
        step_s = -float(np.sum(derivative * residual)) / max(float(np.sum(derivative**2)), 1e-30)
        value_s = max(value_s + float(np.clip(step_s, -_STRIDE_S, _STRIDE_S)), start_s - _LONGEST_S)
        if abs(step_s) < _CONVERGED_S:
            break
    return _with_interval(residuals, value_s)


def _delay(residuals: Callable[[float], FloatArray], low_s: float, high_s: float, of: str) -> Delay:
    """Delay of least squares on a grid, refined; its interval allows for autocorrelation."""
    grid = np.linspace(low_s, high_s, round((high_s - low_s) / _GRID_S) + 1)
    costs = [float(np.sum(residuals(s) ** 2)) for s in grid]
    at = int(np.argmin(costs))
    none = MisfitError(
        f"{of}: no delay within {low_s:g} … {high_s:g} s explains the motion",
        "check the clocks of camera and robot",
    )
    # a delay next to 0 is plausible, as none is shorter than 0
    if at == len(grid) - 1 or (at == 0 and low_s != 0.0):
        raise none
    delay = _gauss_newton(residuals, float(grid[at]))
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
    """A delay with its interval, which allows for autocorrelated residuals."""
    residual, derivative = residuals(value_s), _slope(residuals, value_s)
    rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
    score = np.sum(derivative * residual, axis=1)
    total = sum_variance(score)
    information = float(np.sum(derivative**2))
    white = float(np.sum(residual**2)) / (residual.size - 3) * information
    spread_s = np.sqrt(max(total, white)) / information
    return Delay(value_s, float(student_quantile(max(5, len(score) // 4), 0.975) * spread_s), rms)


def _smooth(values: FloatArray, t_s: FloatArray) -> FloatArray:
    """Measured poses without their noise, which would favour delays that put frames between them.

    source  Savitzky & Golay 1964: cubics over `_SMOOTHED_S`
    """
    from scipy.signal import savgol_filter  # half a second, needed for a calibration only

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
