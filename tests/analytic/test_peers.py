"""The same chain in other hands: MuJoCo, and the paper's own particles."""

import numpy as np
import pytest

from cell.cable.clamp import motion_splines
from cell.cable.particles import Particles, simulate_particles

mujoco = pytest.importorskip("mujoco")

N, LENGTH, MASS, STIFFNESS, DAMPING = 10, 0.01, 7.4e-5, 3e-3, 1e-5


def mujoco_tip(motion, times, step):
    """Tip against time of ten thin rods; the hand's acceleration enters as gravity."""
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
    splines = motion_splines(motion)
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
    ours = links(
        np.full(N, STIFFNESS), np.full(N, DAMPING), rods, rods * LENGTH / 2,
        rods * LENGTH**2 / 3, LENGTH, jerk, times,
    )  # fmt: skip
    # MuJoCo's integrator is of first order: extrapolate
    coarse, fine = mujoco_tip(jerk, times, 2e-4), mujoco_tip(jerk, times, 1e-4)
    assert np.linalg.norm(ours[:, -1] - (2 * fine - coarse), axis=1).max() < 5e-5


def test_particles_approach_the_chain_as_the_springs_stiffen(jerk, links):
    times = np.linspace(0.0, 0.6, 31)
    mass = np.full(N, MASS)
    mass[-1] /= 2  # half a segment hangs on the last node
    bending = np.full(N, STIFFNESS)
    bending[0] *= 2  # the clamp's hinge stands for half a segment
    chain = links(
        bending, np.full(N, DAMPING), mass, mass * LENGTH, mass * LENGTH**2, LENGTH, jerk, times
    )
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
