"""Tasks of the speed measurements: cables on several offsets, and the shortest of several runs."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.effects import library
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from tools.worlds.made_studies import CABLE, moved

MODEL = CableModel.uniform(CABLE, 3e-5, 1.0, 1e-7)
ARC = np.linspace(0.1, 0.0, 11)
ALLOWED_M = 5e-5
DURATION_S = 2.0
TIMES = np.arange(0.0, DURATION_S, 0.005)


def offset_motion(offset_m: float, scale: float = 1.0) -> Motion:
    """Motion down by the offset, then 50 mm to the left; `scale` times as far."""
    t_s = np.arange(0.0, 1.0, 0.002)
    down = moved(t_s, (0.0, -offset_m * scale), 0.25, begin_s=0.05)
    return replace(moved(t_s, (-0.05 * scale, 0.0), 0.3, begin_s=0.4), y_m=down.y_m)


MOTIONS = [offset_motion(0.002 * k) for k in range(21)]


@dataclass(frozen=True, eq=False)
class RodTask:
    """Tips of several lanes at the same times.

    models, motions  of each lane; all models have the same mesh of the same cable, and no effect
                     but `air_drag`; the clamp stays level
    times_s          (times,) multiples of times_s[1], the first is 0
    """

    name: str
    models: tuple[CableModel, ...]
    motions: tuple[Motion, ...]
    times_s: np.ndarray

    @property
    def cable(self) -> Cable:
        return self.models[0].cable

    @property
    def period_s(self) -> float:
        """Interval of the times, s."""
        return float(self.times_s[1])

    @property
    def simulated_s(self) -> float:
        """Simulated time of all lanes, s."""
        return len(self.models) * self.times_s.size * self.period_s

    def part(self, every: int) -> RodTask:
        """The task with every n-th of its lanes."""
        return replace(self, models=self.models[::every], motions=self.motions[::every])


def on_offsets(name: str, model: CableModel, scale: float = 1.0, offsets: int = 21) -> RodTask:
    """A model on offsets of 0 to 40 mm."""
    motions = [offset_motion(x, scale) for x in np.linspace(0.0, 0.04, offsets)]
    return RodTask(name, (model,) * offsets, tuple(motions), TIMES)


def gradient() -> RodTask:
    """A model and 15 others, each with one parameter changed by 0.1 %: forward differences.

    Parameters: EI at 13 knots, viscosity and drag coefficient.
    """
    drag, base = library()["air_drag"], np.array([*np.linspace(3.4e-5, 2.6e-5, 13), 1e-7, 2.0])
    lanes = base * (1.0 + 1e-3 * np.eye(16, 15, -1))
    models = [
        CableModel(CABLE, q[:13], 1.0, q[13], effects=(drag.active(drag_coefficient=q[14]),))
        for q in lanes
    ]
    return RodTask("gradient, 15 parameters", tuple(models), (MOTIONS[-1],) * len(models), TIMES)


def rod_tasks() -> dict[str, RodTask]:
    """The tasks of the benchmark of rods.  Droop: weight per length · L³ / EI."""
    drag = (library()["air_drag"].active(drag_coefficient=2.0),)
    stiff, long = Cable(0.06, 0.02, 0.016, 1e-3), Cable(2.0, 0.05, 0.01, 0.004)
    tasks = (
        on_offsets("10 cm, droop 2.4", MODEL),
        on_offsets("6 cm, droop 0.5", CableModel.uniform(stiff, 8.5e-5, 1.0, 8.5e-8)),
        on_offsets("2 m, droop 10", CableModel.uniform(long, 0.39, 1.0, 4e-3), 4.0),
        on_offsets("10 cm, droop 20", CableModel.uniform(CABLE, 3.6e-6, 1.0, 1.2e-8)),
        on_offsets("10 cm, air drag", CableModel.uniform(CABLE, 3e-5, 1.0, 1e-7, effects=drag)),
        gradient(),
    )
    return {task.name: task for task in tasks}


def best_of(
    *functions: Callable[[], object],
    rounds: int = 9,
    clock: Callable[[], float] = time.perf_counter,
) -> list[float]:
    """Shortest time of each, s; measured alternately, so that load affects all equally."""
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
    """Root mean square distance over all offsets and times, m; infinite if tips are not finite."""
    with np.errstate(all="ignore"):
        error = float(np.sqrt(np.mean(np.sum((tips - exact) ** 2, axis=-1))))
    return error if np.isfinite(error) else np.inf
