"""The hand that is not quite where the robot says."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from cell.cable.effects.base import Effect, FloatArray, HandMotion, Parameter

#: The hand is still below this share of the log's highest speed.  It rests for good a little later:
#: a motion ends with its speed falling as the square of the time left, which two speeds tell.
_STILL, _SLOW = 0.02, 0.05
_LOOK_S = 1e-3


class RobotLag(Effect):
    """The hand is at the logged pose of t − δ."""

    name = "robot_lag"
    parameters = (Parameter("delay_s", "s", -0.1, 0.1, 0.0, (0.005, -0.005)),)

    @staticmethod
    def clamp(pose: HandMotion, p: Any) -> Any:
        """True pose against time."""
        return lambda t: pose(t - p.delay_s)


class RobotRinging(Effect):
    """After every stop the hand rings along the direction in which it came.

    A e^(−ζωt) sin ωt with ω = 2π·frequency, t from `onset_s` after the end of the stop: that of a
    smooth one is only roughly seen in a log, and a hundredth of a second is a third of a radian.
    """

    name = "robot_ringing"
    parameters = (
        Parameter("amplitude_m", "m", -0.01, 0.01, 0.0, (3e-4, -3e-4)),
        Parameter("frequency_hz", "Hz", 1.0, 100.0, 12.0, (12.0, 6.0, 25.0), amplitude=False),
        Parameter("damping", "1", 0.0, 1.0, 0.05, (0.05, 0.2), amplitude=False),
        Parameter("onset_s", "s", -0.05, 0.05, 0.0, (0.0,), amplitude=False),
    )

    @staticmethod
    def clamp(pose: HandMotion, p: Any) -> Any:
        """True pose against time."""
        stops = _stops(pose)
        omega = 2.0 * np.pi * p.frequency_hz

        def ringing(t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            x, y, angle = pose(t)
            for stop_s, along_x, along_y in stops:
                since = np.maximum(np.asarray(t) - stop_s - p.onset_s, 0.0)
                a = p.amplitude_m * np.exp(-p.damping * omega * since) * np.sin(omega * since)
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
    moving = speed > _STILL * speed.max()
    begins = np.flatnonzero(moving[1:] & ~moving[:-1]) + 1
    ends = np.flatnonzero(moving[:-1] & ~moving[1:]) + 1
    stops = []
    for end in ends:
        begin = max((b for b in begins if b < end), default=0)
        if speed[begin:end].max() < 0.2 * speed.max():
            continue
        dx, dy = x[end] - x[begin], y[end] - y[begin]
        length = float(np.hypot(dx, dy))
        if length > 0.0:
            stop_s = float(t[end]) + _left_s(speed[begin : end + 1] / speed.max())
            stops.append((stop_s, float(dx) / length, float(dy) / length))
    return stops


def _left_s(share: FloatArray) -> float:
    """Time until rest after the last of these speeds, shares of the highest, `_LOOK_S` apart."""
    late = np.flatnonzero(share > _SLOW)[-1]
    fast, slow = np.sqrt(share[late]), np.sqrt(share[-1])
    if not fast > slow:
        return 0.0
    return float(_LOOK_S * (len(share) - 1 - late) * slow / (fast - slow))
