"""Errors of the gripper's logged pose: lag and ringing."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import Effect, HandMotion, Parameter

#: The gripper is still below this share of the log's highest speed.
_STILL = 0.02
#: Remaining shares of a motion's length from which its end is extrapolated.
_NEAR, _FAR = 1e-3, 0.03
_LOOK_S = 1e-3
#: A fit of ringing with damping 0.05 converges from frequencies up to some 7 % off.
_FREQUENCIES_HZ = tuple(float(f"{f:.3g}") for f in np.geomspace(1.5, 60.0, 27))
#: Consecutive samples above `_STILL` that count as a motion; fewest samples of an extrapolation.
_LASTS, _LEAST_SAMPLES = 10, 5


class RobotLag(Effect):
    """The gripper is at the logged pose of t − δ."""

    name = "robot_lag"
    parameters = (Parameter("delay_s", "s", -0.1, 0.1, 0.0, (0.005, -0.005)),)

    @staticmethod
    def clamp(pose: HandMotion, p: Any) -> Any:
        """True pose against time."""
        return lambda t: pose(t - p.delay_s)


class RobotRinging(Effect):
    """After every stop the gripper rings along the direction in which it came.

    A e^(−ζωt) sin ωt with ω = 2π·frequency, t from `onset_s` after the end of the stop: that of a
    smooth one is only roughly seen in a log, and a hundredth of a second is a third of a radian.
    """

    name = "robot_ringing"
    parameters = (
        Parameter("amplitude_m", "m", -0.01, 0.01, 0.0, (3e-4, -3e-4)),
        Parameter(
            "frequency_hz",
            "Hz",
            1.0,
            100.0,
            12.0,
            (12.0, 6.0, 25.0),
            amplitude=False,
            scan=_FREQUENCIES_HZ,
        ),
        Parameter("damping", "1", 0.0, 1.0, 0.05, (0.05, 0.2), amplitude=False),
        Parameter("onset_s", "s", -0.05, 0.05, 0.0, (0.0,), amplitude=False),
    )

    @staticmethod
    def clamp(pose: HandMotion, p: Any) -> Any:
        """True pose against time."""
        stops = _stops(pose)
        omega = 2.0 * np.pi * p.frequency_hz
        decay = p.damping * omega

        def ringing(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            x, y, angle = pose(t)
            for stop_s, along_x, along_y in stops:
                since = np.asarray(t) - stop_s - p.onset_s
                rings = since > 0.0
                after = since[rings]
                a = np.zeros_like(since)
                a[rings] = p.amplitude_m * np.exp(-decay * after) * np.sin(omega * after)
                x, y = x + a * along_x, y + a * along_y
            return x, y, angle

        return ringing


@lru_cache(maxsize=64)
def _stops(pose: HandMotion) -> list[tuple[float, float, float]]:
    """Time of every stop and unit vector of the motion before it."""
    t = np.arange(pose.start_s, pose.end_s + 2.0 * _LOOK_S, _LOOK_S)
    x, y, _ = pose(t)
    speed = np.hypot(np.diff(x), np.diff(y)) / _LOOK_S
    if speed.max() == 0.0:
        return []
    still = _STILL * speed.max()
    moving = speed > still
    begins = np.flatnonzero(moving[1:] & ~moving[:-1]) + 1
    ends = np.flatnonzero(moving[:-1] & ~moving[1:]) + 1
    stops = []
    for end in ends:
        begin = max((b for b in begins if b < end), default=0)
        if speed[begin:end].max() < 0.2 * speed.max():
            continue
        # noise that rises above the limit of speed now and then is no new motion
        after = next((b for b in begins if b > end and speed[b : b + _LASTS].min() > still), len(x))
        rest = slice(min(end + (after - end) // 2, len(x) - 1), after)
        rest_x, rest_y = float(np.median(x[rest])), float(np.median(y[rest]))
        away = np.hypot(x[begin:end] - rest_x, y[begin:end] - rest_y)
        if away[0] > 0.0:
            along = (rest_x - float(x[begin])) / away[0], (rest_y - float(y[begin])) / away[0]
            stops.append((_end_s(t[begin:end], away / away[0]), *along))
    return stops


def _end_s(t: FloatArray, remaining: FloatArray) -> float:
    """End time of a motion, extrapolated from its remaining shares (T,) at times t.

    The remaining distance falls as the cube of the remaining time.  It is extrapolated from shares
    above `_NEAR`, because below them the log's noise dominates.
    """
    far = np.flatnonzero(remaining > _FAR)
    begin = int(far[-1]) if far.size else 0
    near = remaining[begin:] > _NEAR
    root = np.cbrt(remaining[begin:][near])
    if len(root) < _LEAST_SAMPLES:
        return float(t[-1])
    # a time's error is noise / speed, which falls as the square of the remaining time
    return float(np.polyfit(root, t[begin:][near], 2, w=root**2)[-1])
