"""The exported chain in MuJoCo, compared with the project's engine: distance of the tips."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.exchange.chain import Chain, resting_bends
from cell.exchange.mjcf import mjcf, mujoco_library, resting_qpos, without_log
from cell.plan.measuring import quintic
from cell.study.data import Study

#: Limit of an export: the tip's difference to the engine, root mean square, m.
BAR_M = 1e-4
#: The engine's mesh and step of the reference: a quarter and a third of its usual ones, whose error
#: of 0.02 mm is of second order in both.
REFERENCE = Solver(segments=112, step_s=0.25e-3)
#: The motion with which every export is compared: 50 mm down in 0.3 s, as the cell identifies.
STROKE_M, STROKE_S, STILL_S, HOLD_S = 0.05, 0.3, 0.1, 0.9
#: Interval at which tips are compared, s.
COMPARED_S = 0.005


@dataclass(frozen=True, eq=False)
class PeerTrial:
    """A motion in which the two programs are compared.

    straight_until_s  the cable is held straight along the clamp angle until then; None = at rest
    """

    name: str
    motion: Motion
    start_s: float
    end_s: float
    straight_until_s: float | None = None


@dataclass(frozen=True)
class TipDifference:
    """Distance between the tips in one motion, m: root mean square over time, and largest."""

    name: str
    rms_m: float
    most_m: float


def stroke() -> PeerTrial:
    """The gripper moves 50 mm down, from rest to rest, and holds."""
    end = STILL_S + STROKE_S + HOLD_S
    t = np.arange(0.0, end + 1e-9, 0.002)
    down = -STROKE_M * quintic(np.clip((t - STILL_S) / STROKE_S, 0.0, 1.0))
    return PeerTrial("50 mm stroke", Motion(t, np.zeros_like(t), down, np.zeros_like(t)), 0.0, end)


def trials_of(study: Study) -> tuple[tuple[PeerTrial, ...], tuple[str, ...]]:
    """The motions of a study, and the names of trials that begin bent, which are omitted."""
    trials = []
    for t in study.trials:
        if not t.bent:
            first = min(t.grip.t_s[0], t.markers.t_s[0]) if t.release_s is None else t.release_s
            last = float(t.markers.t_s[-1])
            trials.append(PeerTrial(t.name, t.grip, float(first), last, t.release_s))
    return tuple(trials), tuple(t.name for t in study.trials if t.bent)


def engine_tip(model: CableModel, trial: PeerTrial, times_s: FloatArray) -> FloatArray:
    """(T, 2) the tip by the project's engine, m.  Raises `simulate`'s errors."""
    straight = trial.straight_until_s is not None
    return np.asarray(
        simulate(
            model,
            trial.motion,
            times_s,
            np.array([model.cable.length_m]),
            solver=REFERENCE,
            start="straight" if straight else "equilibrium",
            release_s=trial.straight_until_s,
        )[0, :, 0]
    )


def mujoco_tip(
    xml: str, chain: Chain, bends_rad: FloatArray, trial: PeerTrial, times_s: FloatArray
) -> FloatArray:
    """(T, 2) the tip by MuJoCo, nan from where it diverges on, m.

    MuJoCo's integrator sets velocities between the instants of the positions, as leapfrog does.
    So the second difference of the path is the acceleration that brings the gripper along it.
    """
    mujoco = mujoco_library()
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    h = float(model.opt.timestep)
    steps = round((times_s[-1] - times_s[0]) / h)
    t = times_s[0] + h * np.arange(-1, steps + 2)
    path = np.stack([spline(t) for spline in trial.motion.splines], axis=1)
    path[0] = path[1]  # from rest
    control = np.diff(path, 2, axis=0) / h**2
    data.qpos[:] = resting_qpos(chain, path[1], bends_rad)
    every = round((times_s[1] - times_s[0]) / h)
    tip = data.site("tip").xpos
    mujoco.mj_kinematics(model, data)
    tips = np.full((len(times_s), 2), np.nan)
    tips[0] = tip[[0, 2]]
    kinds = mujoco.mjtWarning  # after these MuJoCo has restarted from its initial state
    unstable = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
    with without_log():
        for k in range(steps):
            data.ctrl[:] = control[k]
            mujoco.mj_step(model, data)
            if any(data.warning[int(w)].number for w in unstable):
                break
            if (k + 1) % every == 0:
                mujoco.mj_kinematics(model, data)
                tips[(k + 1) // every] = tip[[0, 2]]
    return tips


def difference(name: str, tip_m: FloatArray, other_m: FloatArray) -> TipDifference:
    """Distance of two tips (T, 2); infinite if one has diverged."""
    apart = np.linalg.norm(tip_m - other_m, axis=1)
    if not np.all(np.isfinite(apart)):
        return TipDifference(name, np.inf, np.inf)
    return TipDifference(name, float(np.sqrt(np.mean(apart**2))), float(apart.max()))


@dataclass(frozen=True, eq=False)
class Reference:
    """The engine's tip, (T, 2), m, in a motion, at instants (T,), s."""

    trial: PeerTrial
    times_s: FloatArray
    tip_m: FloatArray

    @classmethod
    def of(cls, model: CableModel, trial: PeerTrial) -> Reference:
        """By the project's engine on its fine mesh.  Raises `simulate`'s errors."""
        count = int((trial.end_s - trial.start_s) / COMPARED_S + 1e-9)
        times = np.asarray(trial.start_s + COMPARED_S * np.arange(count + 1.0))
        return cls(trial, times, engine_tip(model, trial, times))


def compare(model: CableModel, chain: Chain, step_s: float, reference: Reference) -> TipDifference:
    """Distance of MuJoCo's tip from the engine's, for a step that divides 5 ms."""
    xml = mjcf(chain, step_s, resting_bends(model, chain.links, 0.0), ())
    trial = reference.trial
    angle = float(trial.motion.splines[2](np.array([trial.start_s]))[0])
    bends = resting_bends(model, chain.links, angle)
    if trial.straight_until_s is not None:
        bends = np.zeros_like(bends)
    tip = mujoco_tip(xml, chain, bends, trial, reference.times_s)
    return difference(trial.name, tip, reference.tip_m)
