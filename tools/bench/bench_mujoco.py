"""MuJoCo's batch runner on the tasks of the speed measurements: the engine's peer."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import mujoco
import numpy as np
from mujoco import rollout

from cell.cable import layout as at
from cell.cable.assembly import assemble
from cell.cable.effects.air import AIR_DENSITY_KG_PER_M3, AirDrag
from cell.cable.model import CableModel
from cell.cable.solver import threads
from cell.cable.statics import settle
from cell.exchange.chain import value
from tools.bench.bench_task import RodTask
from tools.bench.rod_entrants import DIVISORS, MESHES, RodSetting, Run

INTEGRATORS = ("implicitfast", "Euler", "RK4")
#: Mass of the base over the cable's, which then does not move it.
HEAVY = 1e6


@lru_cache(maxsize=1)
def pool() -> rollout.Rollout:
    """As many threads as cores."""
    return rollout.Rollout(nthread=threads())


def fields_of(model: CableModel, segments: int) -> np.ndarray:
    """(segments + 1, fields) of the engine's bodies, at rest."""
    (block,) = assemble([model], segments, 0.0)
    settle(block, np.zeros(at.BASE_FIELDS * at.LANES))
    return block.state.reshape(segments + 1, at.FIELDS, at.LANES)[:, :, 0]


def chain(model: CableModel, fields: np.ndarray, setting: RodSetting) -> mujoco.MjModel:
    """Thin rods on hinges, and a heavy base on two slides that carries them along the path.

    The engine's own mesh, the best known to us.  MuJoCo's fluid infers a strip from the inertias.
    """
    opened, reach = "", fields[0, at.LENGTH]
    across = model.cable.width_m**2 / 12
    for body in fields[1:]:
        length = body[at.LENGTH]
        mass = model.cable.line_density_kg_per_m * length
        about, thin = mass * length**2 / 12, 1e-12 * mass
        per = body[at.PER_LENGTH]
        opened += (
            f'<body pos="{-reach} 0 0"><joint type="hinge" axis="0 -1 0" '
            f'stiffness="{body[at.RIGIDITY] * per}" damping="{body[at.VISCOSITY] * per}"/>'
            f'<inertial pos="{-length / 2} 0 0" mass="{mass}" diaginertia='
            f'"{mass * across + thin} {about + thin} {mass * across + about}"/>'
        )
        reach = length
    base_kg = HEAVY * model.cable.line_density_kg_per_m * model.cable.free_length_m
    air = AIR_DENSITY_KG_PER_M3 * value(model, AirDrag, "drag_coefficient")
    xml = (
        '<mujoco><compiler boundmass="0" boundinertia="0" balanceinertia="true"/>'
        f'<option integrator="{setting.kind}" timestep="{setting.step_s}" density="{air}">'
        '<flag contact="disable" constraint="disable"/></option><worldbody>'
        '<body gravcomp="1"><joint name="x" type="slide" axis="1 0 0"/>'
        '<joint name="y" type="slide" axis="0 0 1"/>'
        f'<inertial pos="0 0 0" mass="{base_kg}" diaginertia="1e-9 1e-9 1e-9"/>{opened}'
        f"{'</body>' * (len(fields) - 1)}</body></worldbody>"
        f'<actuator><motor joint="x" gear="{base_kg}"/><motor joint="y" gear="{base_kg}"/>'
        "</actuator></mujoco>"
    )
    return mujoco.MjModel.from_xml_string(xml)


class MujocoEntrant:
    """`mujoco.rollout`: one lane per rollout, all cores."""

    name, package = "MuJoCo", "mujoco"

    def settings(self, task: RodTask) -> Iterator[RodSetting]:
        """Meshes, integrators and steps."""
        for n in MESHES:
            per_step_s = (3.5 + 0.35 * n + 0.0115 * n**2) * 1e-6
            for step_s in task.period_s / np.array(DIVISORS):
                steps = len(task.models) * task.times_s[-1] / step_s
                for kind in INTEGRATORS:
                    work_s = (4.0 if kind == "RK4" else 1.0) * per_step_s * steps
                    if kind == "implicitfast" and task.models[0].effects:
                        work_s *= 3.0  # derivatives of the drag
                    yield RodSetting(n, float(step_s), kind, work_s)

    def runner(self, task: RodTask, setting: RodSetting) -> Run:
        mujoco.set_mju_user_warning(lambda message: None)  # unstable settings are part of a search
        made: dict[int, tuple[mujoco.MjModel, np.ndarray, np.ndarray]] = {}
        for cable in {id(m): m for m in task.models}.values():
            fields = fields_of(cable, setting.segments)
            model = chain(cable, fields, setting)
            data = mujoco.MjData(model)
            data.qpos[2:] = fields[1:, at.BEND]
            full = mujoco.mjtState.mjSTATE_FULLPHYSICS
            initial = np.empty(mujoco.mj_stateSize(model, full))
            mujoco.mj_getState(model, data, initial, full)
            made[id(cable)] = model, initial, fields[:, at.LENGTH]
        models, first, lengths = zip(*(made[id(m)] for m in task.models), strict=True)
        work = [mujoco.MjData(models[0]) for _ in range(pool().nthread)]
        every = round(task.period_s / setting.step_s)
        steps = every * (task.times_s.size - 1)
        edges = setting.step_s * np.arange(steps + 1)
        path = np.array([[s(edges, 1) for s in m.splines[:2]] for m in task.motions])
        control = np.ascontiguousarray(np.swapaxes(np.diff(path, axis=2), 1, 2)) / setting.step_s
        grip = np.array([[s(task.times_s) for s in m.splines[:2]] for m in task.motions])
        part = every * 20  # states of more steps at once do not stay in the cache

        def run() -> np.ndarray:
            state, stored = np.array(first), [np.array(first)[:, None]]
            for begin in range(0, steps, part):
                out, _ = pool().rollout(models, work, state, control[:, begin : begin + part])
                state = np.ascontiguousarray(out[:, -1])
                stored.append(out[:, every - 1 :: every].copy())
            bends = np.concatenate(stored, axis=1)[:, :, 3 : 3 + setting.segments]
            angles = np.concatenate([np.zeros_like(bends[:, :, :1]), np.cumsum(bends, 2)], axis=2)
            tips = [np.einsum("lts,ls->lt", f(angles), lengths) for f in (np.cos, np.sin)]
            return np.asarray(np.stack(tips, axis=2) * -1.0 + np.swapaxes(grip, 1, 2))

        return run
