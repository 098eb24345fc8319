"""The task of the speed measurements: a cable on 21 offsets, and the shortest of several runs."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable

import numpy as np

from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel

CABLE = Cable(0.1, 0.0074, 0.016, 1e-4)
MODEL = CableModel.uniform(CABLE, 3e-5, 1.0, 1e-7)
ARC = np.linspace(0.1, 0.0, 11)
ALLOWED_M = 5e-5
DURATION_S = 2.0
TIMES = np.arange(0.0, DURATION_S, 0.005)


def least_jerk(t: np.ndarray, start_s: float, duration_s: float) -> np.ndarray:
    x = np.clip((t - start_s) / duration_s, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def offset_motion(offset_m: float) -> Motion:
    """Motion down by the offset, then 50 mm to the left."""
    t = np.arange(0.0, 1.0, 0.002)
    down, left = least_jerk(t, 0.05, 0.25), least_jerk(t, 0.4, 0.3)
    return Motion(t, -0.05 * left, -offset_m * down, 0 * t)


MOTIONS = [offset_motion(0.002 * k) for k in range(21)]


def best_of(
    *functions: Callable[[], object],
    rounds: int = 9,
    clock: Callable[[], float] = time.perf_counter,
) -> list[float]:
    """Shortest time of each, s; taken in turns, so that a busy machine hits all alike."""
    shortest = [np.inf] * len(functions)
    gc.disable()
    for _ in range(rounds):
        for k, function in enumerate(functions):
            start = clock()
            function()
            shortest[k] = min(shortest[k], clock() - start)
    gc.enable()
    return shortest


def tip_error(tips: np.ndarray, exact: np.ndarray) -> float:
    """Root mean square distance over all offsets and times, m."""
    return float(np.sqrt(np.mean(np.sum((tips - exact) ** 2, axis=-1))))
