"""Simulators of planar rods behind one interface: this engine and its peers.

An entrant offers settings with the work that each costs, and runs a task with one of them.  MuJoCo
and PyElastica get a mesh of second order, which has half a segment in the clamp, as the engine has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from typing import Protocol

import numpy as np

from cell.cable.dynamics import simulate
from cell.cable.solver import DivergedError, Solver
from cell.cable.statics import UnsettledError
from tools.bench.bench_task import RodTask

#: Tips, (lanes, times, 2), m.
Run = Callable[[], np.ndarray]
MESHES = (6, 8, 10, 12, 14, 16, 20, 24, 28, 34, 40, 56, 80, 112, 160, 224, 320)
#: Steps by which the period of the times, 5 ms, is divided.
DIVISORS = (1, 2, 3, 4, 5, 6, 8, 10, 14, 20, 28, 40, 56, 80, 112, 160, 224, 320)


@dataclass(frozen=True)
class RodSetting:
    """Setting of an entrant for a task.

    kind    integrator, or other option
    work_s  estimated CPU time of the task, s; a formula, so that each run has the same order
    tied    whether the step is the longest that the mesh allows
    """

    segments: int
    step_s: float
    kind: str
    work_s: float = 0.0
    tied: bool = False

    def series(self) -> list[tuple[object, ...]]:
        """Series of this setting: refined steps of a mesh, refined meshes with a step."""
        steps = ("steps", self.segments, self.kind)
        return [steps, ("meshes", 0.0 if self.tied else self.step_s, self.kind)]


class RodEntrant(Protocol):
    """A simulator.  `package`: its distribution."""

    name: str
    package: str

    def settings(self, task: RodTask) -> Iterator[RodSetting]:
        """All settings of the search."""

    def runner(self, task: RodTask, setting: RodSetting) -> Run:
        """The task, ready to run; its result is nan if it diverges."""


class EngineEntrant:
    """This project's engine, all lanes at once."""

    name, package = "engine", "cable-cell"

    def settings(self, task: RodTask) -> Iterator[RodSetting]:
        """Meshes, steps and dampings ρ∞ of generalised-α."""
        lanes = 8 * -(-len(task.models) // 8)
        per_segment = 2.7e-8 * (1.6 if task.models[0].effects else 1.0)
        for n in MESHES:
            for step_s in task.period_s / np.array(DIVISORS):
                work_s = per_segment * (n + 4) * lanes * task.times_s[-1] / step_s
                for damping in (0.8, 1.0):
                    yield RodSetting(n, float(step_s), f"damping {damping}", work_s)

    def runner(self, task: RodTask, setting: RodSetting) -> Run:
        solver = Solver(setting.segments, setting.step_s, float(setting.kind.split()[1]))
        arc, model = np.array([task.cable.free_length_m]), len({*map(id, task.models)}) == 1
        models = task.models[0] if model else task.models

        def run() -> np.ndarray:
            try:
                simulated = simulate(models, task.motions, task.times_s, arc, solver=solver)
            except (DivergedError, UnsettledError):
                return np.full((len(task.models), task.times_s.size, 2), np.nan)
            return simulated[:, :, 0]

        return run


#: Peers: module and class of each.
PEERS = {
    "MuJoCo": ("bench_mujoco", "MujocoEntrant"),
    "PyElastica": ("bench_elastica", "ElasticaEntrant"),
}


def entrants() -> tuple[dict[str, RodEntrant], dict[str, str]]:
    """Entrants by name, and the reasons why others are missing."""
    there: dict[str, RodEntrant] = {"engine": EngineEntrant()}
    absent = {}
    for name, (module, entrant) in PEERS.items():
        try:
            there[name] = getattr(import_module(f"tools.bench.{module}"), entrant)()
        except ImportError as error:
            absent[name] = f"not installed ({error})"
    return there, absent


def versions(entrant: RodEntrant) -> str:
    return f"{entrant.package} {version(entrant.package)}"
