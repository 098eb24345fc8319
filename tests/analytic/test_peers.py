"""The same chain in other hands: MuJoCo, and the paper's own model.

The paper's model: point masses, torque as forces, virtual Voigt springs.  Nodes are numbered from
the gripping point (0, moved) to the tip (n); the paper counts the other way.  Bending at node i < n
acts on the angle between the segments before and after it (before node 0: the clamp).  Segments are
stiff springs with dampers instead of being inextensible, so steps must be tiny.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from cell.cable.arrays import FloatArray
from cell.cable.compiling import compiled
from cell.cable.geometry import GRAVITY_M_PER_S2, Motion

mujoco = pytest.importorskip("mujoco")


N, LENGTH, MASS, STIFFNESS, DAMPING = 10, 0.01, 7.4e-5, 3e-3, 1e-5


def mujoco_tip(motion, times, step):
    """Tip against time of ten thin rods; the gripper's acceleration enters as gravity."""
    rod = MASS * LENGTH**2 / 12
    opened = "".join(
        f'<body pos="{0 if i == 0 else -LENGTH} 0 0"><joint type="hinge" axis="0 -1 0" '
        f'stiffness="{STIFFNESS}" damping="{DAMPING}"/><inertial pos="{-LENGTH / 2} 0 0" '
        f'mass="{MASS}" diaginertia="{rod / 100} {rod} {rod}"/>'
        for i in range(N)
    )
    tip = f'<site name="tip" pos="{-LENGTH} 0 0"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler inertiafromgeom="false" boundmass="0" boundinertia="0" '
        f'balanceinertia="true"/><option integrator="implicitfast" timestep="{step}"/>'
        f"<worldbody>{opened}{tip}{'</body>' * N}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    splines = motion.splines
    steps = round((times[-1] - times[0]) / step)
    middle = times[0] + step * (np.arange(steps) + 0.5)
    x, y = ((s(middle + step / 2, 1) - s(middle - step / 2, 1)) / step for s in splines[:2])
    every = round((times[1] - times[0]) / step)
    mujoco.mj_forward(model, data)
    path = [data.site("tip").xpos[[0, 2]].copy()]
    for k in range(steps):
        model.opt.gravity[:] = (-x[k], 0.0, -9.81 - y[k])
        mujoco.mj_step(model, data)
        if (k + 1) % every == 0:
            mujoco.mj_kinematics(model, data)
            path.append(data.site("tip").xpos[[0, 2]].copy())
    return np.array(path) + np.stack([s(times) for s in splines[:2]], axis=1)


def test_same_chain_as_mujoco(jerk, links):
    times = np.linspace(0.0, 2.0, 101)
    rods = np.full(N, MASS)
    hinges = [np.full(N, STIFFNESS), np.full(N, DAMPING)]
    ours = links(LENGTH, [*hinges, rods, rods * LENGTH / 2, rods * LENGTH**2 / 3], jerk, times)
    # MuJoCo's integrator is of first order: extrapolate
    coarse, fine = mujoco_tip(jerk, times, 2e-4), mujoco_tip(jerk, times, 1e-4)
    assert np.linalg.norm(ours[:, -1] - (2 * fine - coarse), axis=1).max() < 5e-5


@dataclass(frozen=True)
class Particles:
    """A chain of point masses.

    segment_m             length of a segment at rest
    mass_kg               (n,) of nodes 1 … n
    bending_n_m_per_rad   (n,) K_i of nodes 0 … n−1; τ = K sign(φ)|φ|^N, eq. 8 with its sign
    exponent              N
    damping_n_m_s         C of eq. 9, τ += C dφ/dt
    voigt_n_per_m         stiffness of a segment's virtual spring, and its damper, N·s/m
    """

    segment_m: float
    mass_kg: FloatArray
    bending_n_m_per_rad: FloatArray
    exponent: float = 1.0
    damping_n_m_s: float = 0.0
    voigt_n_per_m: float = 1e4
    voigt_n_s_per_m: float = 0.1
    gravity_m_per_s2: tuple[float, float] = GRAVITY_M_PER_S2


def simulate_particles(
    chain: Particles, nodes_m: FloatArray, motion: Motion, times_s: FloatArray, step_s: float
) -> FloatArray:
    """Node positions against time by the classical Runge–Kutta method.

    nodes_m  (n + 1, 2) at the first time, at rest
    times_s  (times,) increasing; node 0 follows `motion`
    returns  (times, n + 1, 2), m
    raises   ValueError: it blew up, which means that the step is too long for the springs
    """
    x, y, angle = motion.splines
    times = np.asarray(times_s, dtype=np.float64)
    out = np.empty((times.size, *nodes_m.shape))
    out[0] = nodes_m
    position, velocity = nodes_m.copy(), np.zeros_like(nodes_m)
    for k in range(1, times.size):
        span = times[k] - times[k - 1]
        steps = max(1, int(np.ceil(span / step_s)))
        half = times[k - 1] + span / (2 * steps) * np.arange(2 * steps + 1, dtype=np.float64)
        clamp = np.stack([x(half), y(half), angle(half), x(half, 1), y(half, 1), angle(half, 1)])
        _advance(
            position,
            velocity,
            clamp,
            span / steps,
            chain.segment_m,
            chain.mass_kg,
            chain.bending_n_m_per_rad,
            chain.exponent,
            chain.damping_n_m_s,
            chain.voigt_n_per_m,
            chain.voigt_n_s_per_m,
            np.asarray(chain.gravity_m_per_s2),
        )
        if not np.all(np.isfinite(position)):
            raise ValueError(
                f"particles diverged before t = {times[k]:.4f} s: step_s = {step_s} is too long "
                f"for voigt_n_per_m = {chain.voigt_n_per_m}"
            )
        out[k] = position
    return out


@compiled
def _forces(
    p: FloatArray,
    v: FloatArray,
    clamp_angle: float,
    clamp_spin: float,
    length: float,
    bending: FloatArray,
    exponent: float,
    damping: float,
    stiffness: float,
    loss: float,
    f: FloatArray,
) -> None:
    n = p.shape[0] - 1
    f[:] = 0.0
    bx, by = -np.cos(clamp_angle), -np.sin(clamp_angle)
    before_spin = clamp_spin
    before_x, before_y = 0.0, 0.0
    for i in range(n):
        dx, dy = p[i + 1, 0] - p[i, 0], p[i + 1, 1] - p[i, 1]
        ux, uy = v[i + 1, 0] - v[i, 0], v[i + 1, 1] - v[i, 1]
        long = np.sqrt(dx * dx + dy * dy)
        tx, ty = dx / long, dy / long
        pull = stiffness * (long - length) + loss * (ux * tx + uy * ty)
        f[i, 0] += pull * tx
        f[i, 1] += pull * ty
        f[i + 1, 0] -= pull * tx
        f[i + 1, 1] -= pull * ty
        # angle to the segment before, and its rate
        bend = np.arctan2(bx * ty - by * tx, bx * tx + by * ty)
        turn_x, turn_y = -ty / long, tx / long
        spin = ux * turn_x + uy * turn_y
        size = abs(bend)
        torque = bending[i] * np.sign(bend) * size**exponent + damping * (spin - before_spin)
        # −torque·∂bend/∂position: a couple on this segment, the opposite one on that before
        f[i + 1, 0] -= torque * turn_x
        f[i + 1, 1] -= torque * turn_y
        f[i, 0] += torque * (turn_x + before_x)
        f[i, 1] += torque * (turn_y + before_y)
        if i > 0:
            f[i - 1, 0] -= torque * before_x
            f[i - 1, 1] -= torque * before_y
        bx, by, before_spin, before_x, before_y = tx, ty, spin, turn_x, turn_y


@compiled
def _advance(
    p: FloatArray,
    v: FloatArray,
    clamp: FloatArray,
    h: float,
    length: float,
    mass: FloatArray,
    bending: FloatArray,
    exponent: float,
    damping: float,
    stiffness: float,
    loss: float,
    gravity: FloatArray,
) -> None:
    n = p.shape[0] - 1
    f = np.empty_like(p)
    q, u = p.copy(), v.copy()
    dp, dv = np.empty_like(p), np.empty_like(p)
    for k in range((clamp.shape[1] - 1) // 2):
        dp[:] = 0.0
        dv[:] = 0.0
        for stage in range(4):
            row = 2 * k + (stage + 1) // 2
            for c in range(2):
                q[0, c] = clamp[c, row]
                u[0, c] = clamp[3 + c, row]
            _forces(
                q,
                u,
                clamp[2, row],
                clamp[5, row],
                length,
                bending,
                exponent,
                damping,
                stiffness,
                loss,
                f,
            )
            weight = h / 6.0 if stage in (0, 3) else h / 3.0
            ahead = h if stage == 2 else 0.5 * h
            for i in range(1, n + 1):
                for c in range(2):
                    speed = u[i, c]
                    change = f[i, c] / mass[i - 1] + gravity[c]
                    dp[i, c] += weight * speed
                    dv[i, c] += weight * change
                    q[i, c] = p[i, c] + ahead * speed
                    u[i, c] = v[i, c] + ahead * change
        for i in range(1, n + 1):
            for c in range(2):
                p[i, c] += dp[i, c]
                v[i, c] += dv[i, c]
                q[i, c] = p[i, c]
                u[i, c] = v[i, c]
    for c in range(2):
        p[0, c] = clamp[c, -1]
        v[0, c] = clamp[3 + c, -1]


def test_particles_approach_the_chain_as_the_springs_stiffen(jerk, links):
    times = np.linspace(0.0, 0.6, 31)
    mass = np.full(N, MASS)
    mass[-1] /= 2  # half a segment hangs on the last node
    bending = np.full(N, STIFFNESS)
    bending[0] *= 2  # the clamp's hinge stands for half a segment
    inertia = [mass, mass * LENGTH, mass * LENGTH**2]
    chain = links(LENGTH, [bending, np.full(N, DAMPING), *inertia], jerk, times)
    straight = np.stack([-LENGTH * np.arange(N + 1), np.zeros(N + 1)], axis=1)

    def distance(voigt):
        model = Particles(
            LENGTH, mass, bending, damping_n_m_s=DAMPING, voigt_n_per_m=voigt, voigt_n_s_per_m=0.02
        )
        nodes = simulate_particles(model, straight, jerk, times, 1e-5)
        return np.linalg.norm(nodes - chain, axis=2).max()

    errors = [distance(voigt) for voigt in (1e2, 1e3, 1e4)]
    assert errors[1] < 0.2 * errors[0]
    assert errors[2] < 0.2 * errors[1]
    assert errors[2] < 2e-5


def test_particles_say_when_the_step_is_too_long(jerk):
    straight = np.stack([-LENGTH * np.arange(N + 1), np.zeros(N + 1)], axis=1)
    chain = Particles(LENGTH, np.full(N, MASS), np.full(N, STIFFNESS), voigt_n_per_m=1e6)
    with pytest.raises(ValueError, match=r"step_s = 0\.001 is too long"):
        simulate_particles(chain, straight, jerk, np.linspace(0.0, 0.5, 6), 1e-3)
