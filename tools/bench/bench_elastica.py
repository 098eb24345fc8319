"""PyElastica on the tasks of the speed measurements: Cosserat rods, all lanes in one block.

A rod is round, with the cable's mass and EI; its radius is a setting: a thick one allows long
steps, a thin one shears, stretches and turns as little as the cable.  The element that is half in
the clamp is held.  Viscosity of bending, which PyElastica lacks, is implemented here as an implicit
damper, which does not shorten the steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import elastica as ea
import numpy as np
from elastica.timestepper.symplectic_steppers import PositionVerlet
from scipy.optimize import root

from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3, AirDrag
from cell.cable.geometry import GRAVITY_M_PER_S2
from cell.cable.model import CableModel
from cell.exchange.chain import value
from tools.bench.bench_task import RodTask
from tools.bench.rod_entrants import RodSetting, Run

MESHES = (11, 16, 24, 36, 54)
#: Radius over the cable's length; step over the longest that is stable.
RADII, COURANT = (0.04, 0.02, 0.01, 0.005, 0.0025), 0.7
#: Lengths of the hinges next to the clamp over an element's, as in the engine.
CLAMP, OUT_OF_PLANE = np.array([26.0, 21.0, 25.0]) / 24.0, np.array([0.0, 0.0, 1.0])


class _Collection(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
    """A simulator with the features of the tasks."""


class _ClampedBases(ea.ConstraintBase):
    """Positions and velocities of the first two nodes and element of every rod, at each step."""

    def __init__(self, fleet: SimpleNamespace, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.fleet = fleet

    def constrain_values(self, system: object, time: float) -> None:
        f, k = self.fleet, round(2.0 * time / self.fleet.step_s)
        if (block := f.block) is not None:
            block.position_collection[:2, f.nodes[:, 0]] = f.grip[k] + f.half
            block.position_collection[:2, f.nodes[:, 1]] = f.grip[k] - f.half
            block.director_collection[:, :, f.elements[:, 0]] = f.level

    def constrain_rates(self, system: object, time: float) -> None:
        f, k = self.fleet, round(2.0 * time / self.fleet.step_s)
        if (block := f.block) is not None:
            for node in (0, 1):
                block.velocity_collection[:2, f.nodes[:, node]] = f.speed[k]
            block.omega_collection[:, f.elements[:, 0]] = 0.0


class _ViscousBending(ea.DamperBase):
    """C dκ/dt: spins of the elements of every rod after a step."""

    def __init__(self, fleet: SimpleNamespace, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.fleet = fleet

    def dampen_rates(self, system: object, time: float) -> None:
        f = self.fleet
        if f.block is not None:
            spin = f.block.omega_collection[0]
            spin[f.elements] = np.matmul(f.damping, spin[f.elements][..., None])[..., 0]


class _WeightAndDrag(ea.NoForces):
    """Weight of every rod, and drag of the air."""

    def __init__(self, fleet: SimpleNamespace) -> None:
        super().__init__()
        self.fleet = fleet

    def apply_forces(self, system: object, time: float = 0.0) -> None:
        f, block = self.fleet, self.fleet.block
        if block is None:
            return
        block.external_forces[1] += f.weight
        if f.drag.any():
            (vx, vy), (tx, ty) = block.velocity_collection[:2], block.tangents[:2]
            vx, vy = 0.5 * (vx[1:] + vx[:-1]), 0.5 * (vy[1:] + vy[:-1])
            across = vy * tx - vx * ty
            force = f.drag * np.abs(across) * across
            for k, part in ((0, force * ty), (1, -force * tx)):
                block.external_forces[k, :-1] += part
                block.external_forces[k, 1:] += part


def _rod(model: CableModel, n: int, radius_m: float, angles: np.ndarray) -> Any:
    """A rod at rest under its weight; the first element is half behind the gripping point."""
    length = model.cable.free_length_m / (n - 0.5)
    tangents = np.stack([-np.cos(angles), -np.sin(angles), np.zeros(n)])
    area, ei = np.pi * radius_m**2, float(np.mean(model.rigidity_n_m2))
    modulus = ei / (0.25 * area * radius_m**2)
    rod = ea.CosseratRod.straight_rod(
        n, np.array([0.5 * length, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), OUT_OF_PLANE,
        n * length, radius_m, model.cable.line_density_kg_per_m / area,
        youngs_modulus=modulus, shear_modulus=modulus,
    )  # fmt: skip
    rod.position_collection[:, 1:] = rod.position_collection[:, :1] + length * np.cumsum(
        tangents, 1
    )
    rod.director_collection[1] = np.cross(tangents, [[0.0, 0.0, 1.0]], axisb=1, axisa=0).T
    rod.director_collection[2] = tangents
    rod.bend_matrix[0, 0] = model.rigidity_at((np.arange(1, n) - 0.5) * length)
    rod.bend_matrix[0, 0, :3] /= CLAMP
    return rod


def _damping(model: CableModel, rod: Any, step_s: float) -> np.ndarray:
    """(elements, elements): spins after a step over those before; the first element is held."""
    n, length = rod.n_elems, rod.rest_lengths[0]
    bends = np.diff(np.eye(n), axis=0)
    lengths = np.full((n - 1, 1), length)
    lengths[:3, 0] *= CLAMP
    rates = model.viscosity_n_m2_s * bends.T @ (bends / lengths)
    inertia = np.broadcast_to(rod.mass_second_moment_of_inertia[0, 0], n)
    rates[0] = 0.0
    return np.linalg.inv(np.eye(n) + step_s * rates / inertia[:, None])


class ElasticaEntrant:
    """PyElastica's position Verlet."""

    name, package = "PyElastica", "pyelastica"

    def settings(self, task: RodTask) -> Iterator[RodSetting]:
        """Meshes, radii and steps that are stable."""
        cable, lanes = task.cable, len(task.models)
        stiffest = max(float(np.max(m.rigidity_n_m2)) for m in task.models)
        for n in MESHES:
            for radius_m in cable.free_length_m * np.array(RADII):
                speed = 2.0 / radius_m * np.sqrt(stiffest / cable.line_density_kg_per_m)
                shortest_m = np.hypot((n - 0.5) / cable.free_length_m, 1.0 / radius_m) ** -1
                parts = int(np.ceil(task.period_s * speed / (COURANT * shortest_m)))
                work_s = parts * task.times_s.size * (1.5e-4 + 4e-7 * n * lanes)
                kind = f"radius {radius_m * 1e3:.3g} mm"
                yield RodSetting(n, task.period_s / parts, kind, work_s, tied=True)

    def runner(self, task: RodTask, setting: RodSetting) -> Run:
        n, radius_m = setting.segments, float(setting.kind.split()[1]) * 1e-3
        every = round(task.period_s / setting.step_s)
        angles = {id(m): _resting(m, n) for m in task.models}
        halves = 0.5 * setting.step_s * np.arange(2 * every * task.times_s.size + 2)
        path = np.array([[s(halves) for s in m.splines[:2]] for m in task.motions])
        speed = np.array([[s(halves, 1) for s in m.splines[:2]] for m in task.motions])

        def run() -> np.ndarray:
            rods = [_rod(m, n, radius_m, angles[id(m)]) for m in task.models]
            half = np.array([[0.5 * rods[0].rest_lengths[0]], [0.0]])
            level = rods[0].director_collection[:, :, :1].copy()
            fleet = SimpleNamespace(
                block=None, step_s=setting.step_s, half=half, level=level,
                grip=path.transpose(2, 1, 0).copy(), speed=speed.transpose(2, 1, 0).copy(),
                damping=np.array([
                    _damping(m, r, setting.step_s) for m, r in zip(task.models, rods, strict=True)
                ]),
            )  # fmt: skip
            cells = _Collection()
            for rod in rods:
                cells.append(rod)
            cells.constrain(rods[0]).using(_ClampedBases, fleet=fleet)
            cells.dampen(rods[0]).using(_ViscousBending, fleet=fleet)
            cells.add_forcing_to(rods[0]).using(_WeightAndDrag, fleet=fleet)
            cells.finalize()
            _gather(fleet, next(iter(cells.final_systems())), task, n)
            return _simulate(cells, fleet, every, task)

        return run


def _resting(model: CableModel, n: int) -> np.ndarray:
    """(n,) angles at which weight and bending of the rod's elements are in equilibrium, rad."""
    length = model.cable.free_length_m / (n - 0.5)
    weight = -GRAVITY_M_PER_S2[1] * model.cable.line_density_kg_per_m * length * np.ones(n)
    weight[-1] *= 0.5
    beyond = np.cumsum(weight[::-1])[::-1]  # carried by each element
    stiff = model.rigidity_at((np.arange(1, n) - 0.5) * length) / length
    stiff[:3] /= CLAMP

    bends = np.zeros(n - 1)
    for share in np.linspace(0.1, 1.0, 10):  # of the weight

        def unbalanced(bends: np.ndarray, share: float = share) -> np.ndarray:
            moments = share * length * np.cos(np.cumsum(bends)) * beyond[1:]
            return np.asarray(bends - np.cumsum(moments[::-1])[::-1] / stiff)

        bends = root(unbalanced, bends, tol=1e-12).x
    return np.concatenate([[0.0], np.cumsum(bends)])


def _gather(fleet: SimpleNamespace, block: Any, task: RodTask, n: int) -> None:
    """Assign slices of the block to the lanes."""
    fleet.nodes = np.array(block.start_idx_in_rod_nodes)[:, None] + np.arange(n + 1)
    fleet.elements = np.array(block.start_idx_in_rod_elems)[:, None] + np.arange(n)
    fleet.weight = np.zeros(block.n_nodes)
    fleet.weight[fleet.nodes] = GRAVITY_M_PER_S2[1] * block.mass[fleet.nodes]
    fleet.drag = np.zeros(block.n_elems)
    for model, elements in zip(task.models, fleet.elements, strict=True):
        per_metre = 0.5 * AIR_DENSITY_KG_PER_M3 * value(model, AirDrag, "drag_coefficient")
        fleet.drag[elements] = 0.5 * per_metre * model.cable.width_m * block.rest_lengths[elements]
    fleet.block = block


def _simulate(cells: Any, fleet: SimpleNamespace, every: int, task: RodTask) -> np.ndarray:
    """Tips, (lanes, times, 2)."""
    stepper, time_s, last = PositionVerlet(), np.float64(0.0), fleet.nodes[:, -1]
    tips = np.full((len(task.models), task.times_s.size, 2), np.nan)
    with np.errstate(all="ignore"):
        for k in range(task.times_s.size):
            tips[:, k] = fleet.block.position_collection[:2, last].T
            if not np.all(np.isfinite(tips[:, k])):
                break
            for i in range(every if k + 1 < task.times_s.size else 0):
                time_s = np.float64((k * every + i) * fleet.step_s)
                stepper.step(cells, time_s, np.float64(fleet.step_s))
    return tips
