"""A measuring motion: a gripper motion whose only purpose is to observe the cable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from drivers.interfaces import Pose, Trajectory

#: Peak speed, acceleration and jerk of a fifth-order polynomial from rest to rest, over 1 in 1 s.
QUINTIC_PEAKS = (1.875, 10.0 / 3.0**0.5, 60.0)


@dataclass(frozen=True)
class Move:
    """Straight to `goal`, turning on the way, from rest to rest in `duration_s`."""

    goal: Pose
    duration_s: float


@dataclass(frozen=True)
class Measuring:
    """Rest at `start`, filmed for `still_s`; then the moves, one after another; then `hold_s`.

    Poses are in the cell's plane.  `name` is that of the trial which is recorded.
    """

    name: str
    start: Pose
    still_s: float
    moves: tuple[Move, ...]
    hold_s: float


def quintic(share: FloatArray) -> FloatArray:
    """Share of a distance at a share of the time, 0 … 1: fifth-order polynomial, rest to rest."""
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def least_duration_s(way: float, limits: Sequence[float]) -> float:
    """Shortest time of a move over `way` [m or rad] within limits of speed, acceleration, jerk."""
    return max(
        float((peak * way / limit) ** (1.0 / order))
        for order, (peak, limit) in enumerate(zip(QUINTIC_PEAKS, limits, strict=True), start=1)
    )


def measuring_path(start: Pose, moves: Sequence[Move], rate_hz: float) -> Trajectory:
    """The moves as one path from `start`, sampled at the arm's rate.

    Every move is a polynomial of fifth order in its duration, rounded up to the arm's period.
    raises  ValueError: no moves, a duration or a rate that is not > 0
    """
    if not moves or not rate_hz > 0.0 or not all(m.duration_s > 0.0 for m in moves):
        raise ValueError(f"moves {moves} at {rate_hz} Hz: at least one, all durations > 0")
    rows = [np.array([[start.x_m, start.y_m, start.angle_rad]])]
    for move in moves:
        begin = rows[-1][-1]
        end = np.array([move.goal.x_m, move.goal.y_m, move.goal.angle_rad])
        count = int(np.ceil(move.duration_s * rate_hz - 1e-9))
        u = np.minimum(np.arange(1, count + 1) / (rate_hz * move.duration_s), 1.0)
        s = quintic(u)
        rows.append(begin + s[:, None] * (end - begin))
    x, y, angle = np.concatenate(rows).T
    return Trajectory(np.arange(len(x)) / rate_hz, x.copy(), y.copy(), angle.copy())
