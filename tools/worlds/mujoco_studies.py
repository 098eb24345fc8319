"""Studies made by MuJoCo: physics that is independent of the project's own code.

The cable is a chain of 50 rigid links with springs and dampers between them.  The gripper's
acceleration enters as gravity, which is exact as long as it does not turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.geometry import GRAVITY_M_PER_S2, Motion, node_arc_lengths
from cell.study.data import Markers, Study, Trial
from tools.worlds.made_studies import (
    CABLE,
    FRAME_S,
    HOLD_S,
    STILL_S,
    STROKES,
    Stroke,
    coloured,
)

LENGTH_M = CABLE.free_length_m
LINKS = 50
#: MuJoCo integrates to first order: two steps, extrapolated.
STEP_S = 2e-4
GRIP_S = 0.002
#: Interval of the stored states of the chain, between which it is interpolated, s.
KEPT_S = 0.002
NODES_M = node_arc_lengths(LENGTH_M)
#: The magnet's pull is finite at its pole.
MAGNET_RADIUS_M = 0.01


@dataclass(frozen=True)
class Hidden:
    """Physics of a cable beyond the basic model; everything off by default.  SI units.

    point_mass          mass, and its place as a share of the free length
    grip_compliance     rad per N·m
    bending_hysteresis  moment and the curvature over which it turns round
    magnet              pull, N·m, which falls with the square of the distance; place of the pole
    """

    bending_hysteresis: tuple[float, float] = (0.0, 1.2)
    tip_mass: float = 0.0
    point_mass: tuple[float, float] = (0.0, 0.5)
    grip_compliance: float = 0.0
    magnet: tuple[float, float, float] = (0.0, -0.1, -0.15)


@dataclass(frozen=True)
class Specimen:
    """Parameters of a cable: EI at link joints is `rigidity·(1 + wave)`, viscosity C.

    step  factor by which EI is larger beyond a share of the free length
    """

    rigidity_n_m2: float = 2.5e-5
    wave: float = 0.15
    phase: float = 0.3
    viscosity_n_m2_s: float = 1e-7
    step: tuple[float, float] = (1.0, 0.5)
    hidden: Hidden = field(default_factory=Hidden)

    def rigidity(self, share: np.ndarray) -> np.ndarray:
        """EI at shares of the free length."""
        along = 1.0 + self.wave * np.sin(2.0 * np.pi * (0.7 * share + self.phase))
        factor, place = self.step
        return self.rigidity_n_m2 * along * np.where(share > place, factor, 1.0)


class Chain:
    """MuJoCo's chain of one specimen, clamped at an angle in the frame of the gripper."""

    def __init__(self, specimen: Specimen, angle_rad: float, step_s: float, links: int) -> None:
        hidden = specimen.hidden
        self.hidden, self.step_s = hidden, step_s
        self.angle_rad = angle_rad
        link = LENGTH_M / links
        self.soft = hidden.grip_compliance > 0.0
        # A stub of half a link is clamped; joints are half-way between the nodes, as the last
        # half link.  A soft grip lets the stub turn.
        self.size_m = np.array([link / 2] * self.soft + [link] * (links - 1) + [link / 2])
        self.joint_m = np.array([0.0] * self.soft + [(i + 0.5) * link for i in range(links)])
        stiffness = specimen.rigidity(self.joint_m / LENGTH_M) / link
        damping = np.full(len(stiffness), specimen.viscosity_n_m2_s / link)
        if self.soft:
            stiffness[0] = 1.0 / hidden.grip_compliance
            damping[0] = 0.01 * stiffness[0]
        self.link_m, self.stiffness = link, stiffness
        self.mass_kg = CABLE.line_density_kg_per_m * self.size_m
        self.model = mujoco.MjModel.from_xml_string(self._xml(damping))
        self.data = mujoco.MjData(self.model)
        self.friction = np.zeros(len(stiffness))

    def _xml(self, damping: np.ndarray) -> str:
        hidden, opened = self.hidden, ""
        places = np.concatenate([[self.joint_m[0]], np.diff(self.joint_m)])
        mass, share = hidden.point_mass
        body = int(np.searchsorted(self.joint_m, share * LENGTH_M)) - 1
        for i, (place, size) in enumerate(zip(places, self.size_m, strict=True)):
            opened += (
                f'<body pos="{-place} 0 0"><joint type="hinge" axis="0 -1 0" '
                f'stiffness="{self.stiffness[i]}" damping="{damping[i]}"/>'
                f'<geom type="box" size="{size / 2} {CABLE.width_m / 2} {CABLE.thickness_m / 2}" '
                f'pos="{-size / 2} 0 0" mass="{self.mass_kg[i]}"/>'
            )
            if mass and i == body:
                along = self.joint_m[i] - share * LENGTH_M
                opened += f'<geom type="sphere" size="1e-4" pos="{along} 0 0" mass="{mass}"/>'
        if hidden.tip_mass:
            end = -self.size_m[-1]
            opened += (
                f'<body pos="{end} 0 0"><geom type="sphere" size="1e-4" '
                f'mass="{hidden.tip_mass}"/></body>'
            )
        half = self.angle_rad / 2
        return (
            f'<mujoco><compiler angle="radian"/>'
            f'<option integrator="implicitfast" timestep="{self.step_s}">'
            f'<flag contact="disable"/></option>'
            f'<worldbody><body quat="{np.cos(half)} 0 {-np.sin(half)} 0">'
            f"{opened}{'</body>' * len(places)}</body></worldbody></mujoco>"
        )

    def accelerate(self, acceleration: np.ndarray) -> None:
        """Set the effective gravity in the gripper's frame."""
        x, y = np.subtract(GRAVITY_M_PER_S2, acceleration)
        self.model.opt.gravity[:] = (x, 0.0, y)

    def apply(self, hand_place: np.ndarray) -> None:
        """Apply forces that MuJoCo lacks: hysteresis in bending, the magnet."""
        hidden, data = self.hidden, self.data
        data.qfrc_applied[:] = 0.0
        moment, scale = hidden.bending_hysteresis
        if moment:
            rate = data.qvel / self.link_m
            data.qfrc_applied[:] -= moment * self.friction
            self.friction += self.step_s * (rate - self.friction * np.abs(rate)) / scale
        pull, *pole = hidden.magnet
        if pull:
            first = self.model.nbody - len(self.size_m) - bool(hidden.tip_mass)
            centre = data.xipos[first : first + len(self.size_m)][:, [0, 2]] + hand_place
            way = np.array(pole) - centre
            square = np.sum(way**2, axis=1)
            size = pull * self.size_m / ((square + MAGNET_RADIUS_M**2) * np.sqrt(square))
            force = size[:, None] * way
            data.xfrc_applied[first : first + len(self.size_m), 0] = force[:, 0]
            data.xfrc_applied[first : first + len(self.size_m), 2] = force[:, 1]

    def settle(self) -> None:
        """Equilibrium by Newton's method on MuJoCo's own forces, from the straight cable."""
        data, model, nv = self.data, self.model, self.model.nv
        self.accelerate(np.zeros(2))
        full = self.hidden
        self.hidden = replace(full, bending_hysteresis=(0.0, 1.0))

        def force(q: np.ndarray) -> np.ndarray:
            data.qpos[:], data.qvel[:] = q, 0.0
            mujoco.mj_kinematics(model, data)
            self.apply(np.zeros(2))
            mujoco.mj_forward(model, data)
            weight = np.zeros(nv)
            for i in np.flatnonzero(data.xfrc_applied.any(axis=1)):
                mujoco.mj_applyFT(
                    model, data, data.xfrc_applied[i, :3], np.zeros(3), data.xipos[i], i, weight
                )
            return np.asarray(data.qfrc_passive - data.qfrc_bias + weight)

        q = np.zeros(nv)
        for share in (0.25, 0.5, 0.75, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0):
            here = force(q)
            nudge = 1e-6
            slope = np.stack([(force(q + nudge * row) - here) / nudge for row in np.eye(nv)], 1)
            q = q - share * np.linalg.solve(slope, here)
        if np.abs(force(q)).max() > 1e-9 * float(np.abs(self.stiffness).max()):
            raise RuntimeError("the chain does not settle")
        self.hidden = full
        data.qpos[:], data.qvel[:] = q, 0.0

    def swing(self, stroke: Stroke, end_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Times and joint angles (times, joints) from rest until `end_s`."""
        self.settle()
        every = round(KEPT_S / self.step_s)
        steps = every * round(end_s / KEPT_S)
        edges = self.step_s * np.arange(steps + 1)
        place = stroke.place_m(edges)
        velocity = (stroke.place_m(edges + 1e-5) - stroke.place_m(edges - 1e-5)) / 2e-5
        # mean acceleration over each step, so that the gripper's end position is exact
        acceleration = np.diff(velocity, axis=0) / self.step_s
        stored = [self.data.qpos.copy()]
        for k in range(steps):
            self.accelerate(acceleration[k])
            self.apply(place[k])
            mujoco.mj_step(self.model, self.data)
            if (k + 1) % every == 0:
                stored.append(self.data.qpos.copy())
        return KEPT_S * np.arange(len(stored)), np.array(stored)

    def points(self, angles: np.ndarray, share: np.ndarray) -> np.ndarray:
        """(times, markers, 2) points at shares of the cable, from the gripping point, m."""
        tangent = self.angle_rad + np.cumsum(angles, axis=1)
        turn = tangent[:, 0] if self.soft else np.full(len(angles), self.angle_rad)
        inner = tangent[:, int(self.soft) :]
        centre = self.joint_m[int(self.soft) :] + 0.5 * self.size_m[int(self.soft) :]
        knots = np.concatenate([[0.0], centre, [LENGTH_M]])
        values = np.concatenate([turn[:, None], inner, inner[:, -1:]], axis=1)
        fine = np.linspace(0.0, LENGTH_M, 201)
        angle = CubicSpline(knots, values, axis=1)(fine)
        along = -np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        path = CubicSpline(fine, along, axis=1).antiderivative()
        return np.asarray(path(share * LENGTH_M))


def true_markers(
    specimen: Specimen, stroke: Stroke, t_s: np.ndarray, links: int = LINKS, step_s: float = STEP_S
) -> np.ndarray:
    """(times, markers, 2) true places of the markers, m."""
    end_s = float(t_s[-1]) + 0.03
    chains = [Chain(specimen, stroke.angle_rad, step, links) for step in (step_s, step_s / 2)]
    (times, coarse), (_, fine) = (c.swing(stroke, end_s) for c in chains)
    points = chains[0].points(2.0 * fine - coarse, NODES_M / LENGTH_M)
    points = points + stroke.place_m(times)[:, None]
    return np.asarray(CubicSpline(times, points, axis=0)(t_s))


def study_of(
    specimen: Specimen,
    *,
    seed: int,
    strokes: Sequence[Stroke] = STROKES,
    step_s: float = STEP_S,
    links: int = LINKS,
) -> Study:
    """The study of a specimen, filmed with AR(1) noise of 0.1 mm; its gripper's log has none."""
    rng = np.random.default_rng(seed)
    trials = []
    for stroke in strokes:
        end_s = STILL_S + stroke.seconds + HOLD_S
        t_s = np.arange(rng.uniform(0.0, FRAME_S), end_s, FRAME_S)
        points = true_markers(specimen, stroke, t_s, links, step_s)
        points = points + 1e-4 * coloured(rng, points.shape, 0.3)
        logged_s = np.arange(0.0, end_s, GRIP_S)
        angle = np.full(len(logged_s), stroke.angle_rad)
        x_m, y_m = stroke.place_m(logged_s).T.copy()
        hand = Motion(logged_s, x_m, y_m, angle)
        trials.append(Trial(stroke.name, stroke.role, "equilibrium", hand, Markers(t_s, points)))
    return Study(f"mujoco_{seed}", CABLE, NODES_M, tuple(trials))


def specimen(seed: int, hidden: Hidden, step: tuple[float, float] = (1.0, 0.5)) -> Specimen:
    """A random cable with hidden physics."""
    rng = np.random.default_rng([seed, 4])
    return Specimen(
        rigidity_n_m2=float(rng.uniform(1.8e-5, 4e-5)),
        wave=float(rng.uniform(0.05, 0.25)),
        phase=float(rng.uniform()),
        viscosity_n_m2_s=float(rng.uniform(6e-8, 2e-7)),
        step=step,
        hidden=hidden,
    )


def drawn(seed: int, number: int, outside: bool) -> tuple[tuple[str, ...], Hidden]:
    """Hidden physics of a study: a magnet, or an effect by its number, 1 to 3 times typical."""
    size = float(np.random.default_rng([seed, number, 5]).uniform(1.0, 3.0))
    if outside:
        return ("magnet",), Hidden(magnet=(2e-5 * size, -0.1, -0.15))
    kinds = {
        "tip_mass": Hidden(tip_mass=2.5e-5 * size),
        "point_mass": Hidden(point_mass=(2.5e-5 * size, 0.6)),
        "grip_compliance": Hidden(grip_compliance=100.0 * size),
        "bending_hysteresis": Hidden(bending_hysteresis=(4e-6 * size, 1.2)),
    }
    name = sorted(kinds)[number % len(kinds)]
    return (name,), kinds[name]
