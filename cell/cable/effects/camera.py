"""Errors of the camera: latency, scale, roll and rolling shutter."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import CableData, Effect, Parameter

#: Centre of the picture in the plane of motion: the middle of a drooping cable held at the origin.
_CENTRE = (
    Parameter("centre_x_m", "m", -10.0, 10.0, -0.05, (-0.05,), amplitude=False, fitted=False),
    Parameter("centre_y_m", "m", -10.0, 10.0, -0.03, (-0.03,), amplitude=False, fitted=False),
)


class CameraLatency(Effect):
    """A picture stamped t shows the scene of t − δ."""

    name = "camera_latency"
    parameters = (Parameter("delay_s", "s", -0.1, 0.1, 0.0, (0.005, -0.005)),)

    @staticmethod
    def camera_time(cable: CableData, t: FloatArray, xy: FloatArray, p: Any) -> FloatArray:
        """Times of the points' positions in the picture, s."""
        return np.asarray(t - p.delay_s)


class CameraScale(Effect):
    """The picture is larger by a factor, about its centre."""

    name = "camera_scale"
    parameters = (Parameter("factor", "1", 0.5, 2.0, 1.0, (1.01, 0.99)), *_CENTRE)

    @staticmethod
    def camera_points(cable: CableData, xy: FloatArray, p: Any) -> FloatArray:
        """Points in the picture, m."""
        centre = np.array([p.centre_x_m, p.centre_y_m])
        return np.asarray(centre + p.factor * (xy - centre))


class CameraRoll(Effect):
    """The picture is turned about its centre, positive = counter-clockwise."""

    name = "camera_roll"
    parameters = (Parameter("angle_rad", "rad", -0.5, 0.5, 0.0, (0.01, -0.01)), *_CENTRE)

    @staticmethod
    def camera_points(cable: CableData, xy: FloatArray, p: Any) -> FloatArray:
        """Points in the picture, m."""
        c, s = np.cos(p.angle_rad), np.sin(p.angle_rad)
        x, y = xy[..., 0] - p.centre_x_m, xy[..., 1] - p.centre_y_m
        return np.stack([p.centre_x_m + c * x - s * y, p.centre_y_m + s * x + c * y], axis=-1)


class RollingShutter(Effect):
    """Rows lower in the picture are exposed later: t + r·(centre − y)."""

    name = "rolling_shutter"
    parameters = (Parameter("s_per_m", "s/m", -1.0, 1.0, 0.0, (0.05, -0.05)), *_CENTRE[1:])

    @staticmethod
    def camera_time(cable: CableData, t: FloatArray, xy: FloatArray, p: Any) -> FloatArray:
        """Times of the points' positions in the picture, s."""
        return np.asarray(t + p.s_per_m * (p.centre_y_m - xy[..., 1]))
