"""Strokes of the gripper that a cell can make, and a motion of them as a file."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from cell.cable.geometry import Motion
from cell.plan.measuring import least_duration_s, quintic
from cell.settings.surroundings import Surroundings

FORMAT = "cell-motion/1"
STILL_S, HOLD_S, RATE_HZ = 0.2, 1.0, 500.0
ATTITUDES_RAD = tuple(np.radians([-90.0, -60.0, -30.0, -15.0, 0.0, 15.0, 30.0, 60.0, 90.0]))
STROKES_M = (
    (0.0, -0.05), (0.0, -0.08), (0.0, 0.05), (0.0, 0.08),
    (-0.05, 0.0), (-0.08, 0.0), (0.05, 0.0), (-0.05, -0.05),
)  # fmt: skip


SLOWNESS = (1.0, 1.6)
#: Between home and the clamp angle of a stroke, the resting cable is looked at this often, rad.
TURN_RAD = np.radians(15.0)


@dataclass(frozen=True)
class Stroke:
    """From rest at (x, y), clamp at `angle_rad`, straight by (dx, dy) in `duration_s`, held."""

    angle_rad: float
    dx_m: float
    dy_m: float
    duration_s: float
    x_m: float = 0.0
    y_m: float = 0.0

    def describe(self) -> str:
        """For a person."""
        return (
            f"clamp at {np.degrees(self.angle_rad):.0f}°, from ({self.x_m * 1e3:.0f}, "
            f"{self.y_m * 1e3:.0f}) by ({self.dx_m * 1e3:.0f}, {self.dy_m * 1e3:.0f}) mm in "
            f"{self.duration_s:.2f} s"
        )

    def motion(self) -> Motion:
        """The gripper's pose against time: still, a fifth-order polynomial, held."""
        t_s = np.arange(0.0, STILL_S + self.duration_s + HOLD_S, 1.0 / RATE_HZ)
        u = np.clip((t_s - STILL_S) / self.duration_s, 0.0, 1.0)
        s = quintic(u)
        x, y = self.x_m + self.dx_m * s, self.y_m + self.dy_m * s
        return Motion(t_s, x, y, np.full_like(t_s, self.angle_rad))


def strokes(surroundings: Surroundings) -> list[Stroke]:
    """Strokes from home, as fast as the limits allow and slower, the clamp within its limits."""
    found = []
    for angle, (dx, dy), slow in itertools.product(ATTITUDES_RAD, STROKES_M, SLOWNESS):
        if not surroundings.allows(float(angle)):
            continue
        least_s = least_duration_s(
            float(np.hypot(dx, dy)),
            (
                surroundings.velocity_m_per_s,
                surroundings.acceleration_m_per_s2,
                surroundings.jerk_m_per_s3,
            ),
        )
        duration_s = round(slow * least_s + 0.005, 3)
        found.append(Stroke(float(angle), dx, dy, duration_s, *surroundings.home[:2]))
    return found
