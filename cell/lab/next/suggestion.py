"""Motions that are suggested, as data and as a file for `cell run --motion`."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cell.cable.geometry import Motion
from cell.files.atomic import write_atomic
from cell.files.yaml_document import yaml_text
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
#: Step, rad, of the clamp angle between home and stroke at which the resting cable is checked.
TURN_RAD = np.radians(15.0)


@dataclass(frozen=True)
class Stroke:
    """A straight stroke by (dx, dy) in `duration_s` from rest at (x, y), clamp at `angle_rad`."""

    angle_rad: float
    dx_m: float
    dy_m: float
    duration_s: float
    x_m: float = 0.0
    y_m: float = 0.0

    def describe(self) -> str:
        """Text of the stroke."""
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
    result = []
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
        result.append(Stroke(float(angle), dx, dy, duration_s, *surroundings.home[:2]))
    return result


@dataclass(frozen=True)
class Option:
    """A motion within all limits, and how well it distinguishes the candidates.

    separation  χ² between the likeliest candidate and the one hardest to distinguish from it
    hardest     name of that one
    power       probability that the motion decides against every other candidate, if noise and
                candidates are as assumed
    """

    motion: Stroke
    separation: float
    hardest: str
    power: float


@dataclass(frozen=True)
class Suggestion:
    """Motions, the most informative first, and the candidates that they distinguish.

    refused  number of motions refused, by limit
    """

    candidates: tuple[str, ...]
    options: tuple[Option, ...]
    surroundings: Surroundings
    refused: Mapping[str, int]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "format": "cable-suggestion/1",
            "candidates": list(self.candidates),
            "options": [
                {
                    **vars(o.motion),
                    "separation": o.separation,
                    "hardest": o.hardest,
                    "power": o.power,
                }
                for o in self.options
            ],
            "refused": dict(self.refused),
        }


def write_motion(suggestion: Suggestion, path: Path) -> None:
    """Write the best motion as YAML for `cell run --motion`: places from the cell's home."""
    best = suggestion.options[0].motion
    home_x, home_y, _ = suggestion.surroundings.home
    x_m, y_m = best.x_m - home_x, best.y_m - home_y
    first, *rivals = suggestion.candidates
    content = {
        "format": FORMAT,
        "purpose": f"tell {first} from {', '.join(rivals)}",
        "start": {"x_m": round(x_m, 6), "y_m": round(y_m, 6), "angle_rad": best.angle_rad},
        "still_s": STILL_S,
        "moves": [
            {
                "x_m": round(x_m + best.dx_m, 6),
                "y_m": round(y_m + best.dy_m, 6),
                "angle_rad": best.angle_rad,
                "duration_s": best.duration_s,
            }
        ],
        "hold_s": HOLD_S,
    }
    write_atomic(path, yaml_text(content))
