"""A camera that does not look straight at the cable's plane."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.effects.base import CableData, Effect, Parameter


class LensPerspective(Effect):
    """The cable's plane is tilted to the picture: all is narrower, what is further away is smaller.

    `turn_rad` about the vertical through the picture's centre, positive = right side further away;
    `nod_rad` about the level, positive = top further away.  A pinhole at `distance_m` calibrated
    for a plane that is not tilted.  Source: Hartley & Zisserman, Multiple View Geometry, 2004,
    ch. 6.
    """

    name = "lens_perspective"
    parameters = (
        Parameter("turn_rad", "rad", -0.5, 0.5, 0.0, (0.05, -0.05)),
        Parameter("nod_rad", "rad", -0.5, 0.5, 0.0, (0.05, -0.05)),
        Parameter("distance_m", "m", 0.05, 100.0, 0.5, (0.5,), amplitude=False, fitted=False),
        Parameter("centre_x_m", "m", -10.0, 10.0, -0.05, (-0.05,), amplitude=False, fitted=False),
        Parameter("centre_y_m", "m", -10.0, 10.0, -0.03, (-0.03,), amplitude=False, fitted=False),
    )

    @staticmethod
    def camera_points(cable: CableData, xy: FloatArray, p: Any) -> FloatArray:
        """Points in the picture, m."""
        x, y = xy[..., 0] - p.centre_x_m, xy[..., 1] - p.centre_y_m
        across, up = x * np.cos(p.turn_rad), y * np.cos(p.nod_rad)
        up = up - x * np.sin(p.turn_rad) * np.sin(p.nod_rad)
        deep = x * np.sin(p.turn_rad) * np.cos(p.nod_rad) + y * np.sin(p.nod_rad)
        nearer = p.distance_m / (p.distance_m + deep)
        return np.stack([p.centre_x_m + nearer * across, p.centre_y_m + nearer * up], axis=-1)
