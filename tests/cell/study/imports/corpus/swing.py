"""A gripper's path and the places of a cable's markers, known exactly: what files are made from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

LENGTH_M, RATE_HZ = 0.1, 200.0
#: Arc lengths of the markers from the gripping point.
ARCS_M = np.array([0.02, 0.04, 0.06, 0.08, 0.1])
MARKERS = ("m1", "m2", "m3", "m4", "tip")
#: The gripper moves between these times.
BEGINS_S, ENDS_S = 0.4, 0.7
#: A second point of the gripper is so far behind the gripping point, against the cable.
BACK_M = 0.03
_LASTS_S = 1.5
_NOISE_M = 1e-4


@dataclass(frozen=True, eq=False)
class Swing:
    """One trial in the study's plane: x right, y up, the cable to the left of the gripper.

    t_s (T,), gripper_m (T, 2), angle_rad (T,), markers_m (T, 5, 2) from the gripper to the tip,
    nan where one is not seen
    """

    name: str
    t_s: NDArray[np.float64]
    gripper_m: NDArray[np.float64]
    angle_rad: NDArray[np.float64]
    markers_m: NDArray[np.float64]

    @property
    def back_m(self) -> NDArray[np.float64]:
        """(T, 2) the gripper's second point."""
        turned = np.column_stack([np.cos(self.angle_rad), np.sin(self.angle_rad)])
        return self.gripper_m + BACK_M * turned

    def with_lost_tip(self) -> Swing:
        """The same without the tip in 8 rows of the motion."""
        markers_m = self.markers_m.copy()
        markers_m[100:108, -1] = np.nan
        return replace(self, markers_m=markers_m)


def stroke(t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of the gripper's way from 0 to 1, of least jerk."""
    u = np.clip((t_s - BEGINS_S) / (ENDS_S - BEGINS_S), 0.0, 1.0)
    return np.asarray(u**3 * (10 - 15 * u + 6 * u**2))


def times_s(rate_hz: float = RATE_HZ, lasts_s: float = _LASTS_S) -> NDArray[np.float64]:
    """(T,) of a trial."""
    return np.arange(round(lasts_s * rate_hz)) / rate_hz


def swing(
    name: str,
    gripper_m: NDArray[np.float64],
    angle_rad: NDArray[np.float64],
    seed: int,
    t_s: NDArray[np.float64] | None = None,
    noise_m: float = _NOISE_M,
) -> Swing:
    """A cable that keeps its length, hangs bent at rest and rings after the motion; with noise.

    t_s  None = `times_s()`
    """
    t_s = times_s() if t_s is None else t_s
    after_s = np.clip(t_s - BEGINS_S - 0.05, 0.0, None)
    curl = 9.0 - 4.0 * np.exp(-2.0 * after_s) * np.sin(2 * np.pi * 4.0 * after_s)
    fine = np.linspace(0.0, LENGTH_M, 501)
    turn = angle_rad[:, None] + curl[:, None] * (fine - fine**2 / (2 * LENGTH_M))
    steps = np.stack([-np.cos(turn), -np.sin(turn)], axis=2)
    middle = 0.5 * (steps[:, 1:] + steps[:, :-1]) * (fine[1] - fine[0])
    along = np.concatenate([np.zeros((len(t_s), 1, 2)), np.cumsum(middle, axis=1)], axis=1)
    at = np.searchsorted(fine, ARCS_M - 1e-9)
    noise = np.random.default_rng(seed).normal(0.0, noise_m, (len(t_s), len(ARCS_M), 2))
    return Swing(
        name, t_s, gripper_m, angle_rad, np.round(gripper_m[:, None] + along[:, at] + noise, 8)
    )


def known_study() -> tuple[Swing, Swing]:
    """A gripper that goes down by 50 mm, and one that turns by 0.15 rad as it does."""
    way = stroke(times_s())
    down = np.column_stack([np.zeros(len(way)), -0.05 * way])
    turning = np.column_stack([0.01 * way, -0.05 * way])
    return (
        swing("down", down, np.full(len(way), 0.2), seed=1),
        swing("turning", turning, 0.2 + 0.15 * way, seed=2),
    )


def straight_study() -> tuple[Swing, Swing]:
    """A gripper on a vertical axis, which cannot turn."""
    way = stroke(times_s())
    return tuple(
        swing(name, np.column_stack([np.zeros(len(way)), -long_m * way]),
              np.full(len(way), 0.2), seed)
        for name, long_m, seed in (("down", 0.05, 3), ("less", 0.03, 4))
    )  # fmt: skip


def arm_study(radius_m: float) -> tuple[Swing, Swing]:
    """A clamp at the end of an arm whose axle is in the origin: the cable leaves along the arm."""
    way = stroke(times_s())
    found = []
    for name, turn, seed in (("down", 0.5, 5), ("less", 0.3, 6)):
        angle = 0.1 + turn * way
        at = -radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
        found.append(swing(name, at, angle, seed))
    return found[0], found[1]
