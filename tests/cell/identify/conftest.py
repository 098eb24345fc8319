"""Measured cables of a world finer than the model: 60 segments, half the step, own noise."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.plan.paths import MotionLimits, identification_path
from cell.study.data import Markers, Trial
from drivers.interfaces import Pose
from tools.worlds.made_studies import CABLE, WORLD, coloured, logged


@dataclass(frozen=True)
class World:
    """A cable, how it is measured, and the trial of one hold."""

    model: CableModel
    trial: Trial
    clean_m: np.ndarray


Measure = Callable[..., World]


@pytest.fixture(scope="session")
def flat_cable() -> Cable:
    return CABLE


@pytest.fixture(scope="session")
def hold_motion() -> Motion:
    path = identification_path(Pose(0.0, 0.0, 0.02), 0.05, MotionLimits(), 500.0, hold_s=0.9)
    t = np.arange(0.0, path.t_s[-1] + 0.2, 0.002)
    poses = (path.x_m, path.y_m, path.angle_rad)
    return Motion(t, *(np.interp(t - 0.2, path.t_s, v) for v in poses))


@pytest.fixture(scope="session")
def measure(hold_motion: Motion) -> Measure:
    def world(
        model: CableModel,
        seed: int = 0,
        *,
        noise_m: float = 5e-5,
        ar1: float = 0.0,
        log_noise_m: float = 1e-5,
        motion: Motion = hold_motion,
    ) -> World:
        rng = np.random.default_rng(seed)
        t_s = np.arange(0.001, motion.t_s[-1], 0.005)
        arcs = node_arc_lengths(model.cable.length_m)
        clean = simulate(model, motion, t_s, arcs, solver=WORLD)[0]
        markers = Markers(t_s, clean + noise_m * coloured(rng, clean.shape, ar1))
        grip = logged(rng, motion, log_noise_m)
        return World(model, Trial("identify", "fit", "equilibrium", grip, markers), clean)

    return world
