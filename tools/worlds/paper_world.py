"""Data of the paper's figures: cables, motions, measurements and identified models."""

from __future__ import annotations

from functools import cache

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.geometry import Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.identify.individual import identify
from cell.plan.choose import Choice, choose, forecast
from cell.plan.destination import Destination
from cell.plan.paths import MotionLimits, executed_motion, identification_path, insertion_path
from cell.study.data import Markers, Trial
from drivers.interfaces import Pose
from tools.worlds.fast_truth import after_rest
from tools.worlds.made_studies import CABLE, WORLD, filmed, logged

MODEL = Solver()
LIMITS = MotionLimits()
INSERTION = MotionLimits(0.25, 1.5, 25.0)
NODES_M = node_arc_lengths(0.1)
TIP_M = NODES_M[:1]
NOISE_M = 1e-4
LOWER_M, ADVANCE_M, STILL_S, LAG_S = 0.05, 0.05, 0.2, 0.03
OFFSETS_M = np.arange(21) * 2e-3


@cache
def individuals() -> tuple[CableModel, ...]:
    """Eight cables of one datasheet: stiffness, its course along the cable, N and C differ."""
    rng = np.random.default_rng(8)
    cables = []
    for level in np.geomspace(2.4e-5, 3.3e-5, 8):
        s = np.linspace(0.0, 1.0, 13)
        waves = sum(
            rng.normal() / k * np.cos(np.pi * k * s + rng.uniform(0.0, 2.0 * np.pi))
            for k in (1, 2, 3)
        )
        exponent = float(rng.uniform(0.93, 1.07))
        viscosity = float(level * rng.uniform(3e-3, 6e-3))
        cables.append(CableModel(CABLE, level * np.exp(0.15 * waves), exponent, viscosity))
    return tuple(cables)


@cache
def trio() -> tuple[int, int, int]:
    """Indices of the most, a medium and the least drooping of the eight cables."""
    tips = [
        simulate(m, hold(), np.zeros(1), TIP_M, solver=WORLD)[0, 0, 0, 1] for m in individuals()
    ]
    order = [int(i) for i in np.argsort(tips)]
    return order[0], order[3], order[-1]


@cache
def hold() -> Motion:
    """Motion: 50 mm down, then at rest for a second."""
    path = identification_path(Pose(0.0, 0.0), LOWER_M, LIMITS, 500.0)
    return after_rest(executed_motion(path, LAG_S), STILL_S)


@cache
def insertion(offset_m: float) -> Motion:
    """Motion: down by the offset and 50 mm left, from rest at the lower place."""
    path = insertion_path(Pose(0.0, -LOWER_M), offset_m, ADVANCE_M, INSERTION, 500.0)
    return executed_motion(path, LAG_S, settle_s=0.3)


def measure(model: CableModel, motion: Motion, seed: int, arc_length_m: FloatArray) -> Markers:
    """Markers as a camera at 200 frames/s measures them, with noise."""
    t_s = np.arange(0.001, motion.t_s[-1], 0.005)
    rng = np.random.default_rng(seed)
    return filmed(rng, model, motion, t_s, arc_length_m, noise_m=NOISE_M)


@cache
def identified(index: int) -> tuple[Identified, Markers]:
    """Model of a cable identified from its hold, and the markers used."""
    markers = measure(individuals()[index], hold(), index, NODES_M)
    log = logged(np.random.default_rng([index, 1]), hold(), 1e-5)
    trial = Trial("identify", "fit", "equilibrium", log, markers)
    return identify(trial, NODES_M, CABLE), markers


@cache
def guided() -> tuple[Destination, dict[int, Choice]]:
    """A destination, and the offset chosen for each of three cables."""
    opening = Destination(x_min_m=-0.132, x_max_m=-0.128, y_min_m=-0.108, y_max_m=-0.102)
    motions = [insertion(float(offset)) for offset in OFFSETS_M]
    choices = {}
    for index in trio():
        estimate, _ = identified(index)
        choices[index] = choose(forecast(estimate, OFFSETS_M, motions), estimate, opening)
    return opening, choices


def best_uniform(nodes_m: FloatArray) -> CableModel:
    """The uniform linear cable whose still shape has the least squared distance from `nodes_m`."""
    models = [CableModel(CABLE, np.array([r])) for r in np.geomspace(1e-5, 8e-5, 200)]
    shapes = simulate(models, hold(), np.zeros(1), NODES_M, solver=MODEL)[:, 0]
    return models[int(np.argmin(np.sum((shapes - nodes_m) ** 2, axis=(1, 2))))]


def same_shape(base: CableModel, exponent: float) -> CableModel:
    """A different exponent with the same still shape: EI κ^(N−1) is unchanged."""
    s = np.linspace(0.0, 0.1, 21)
    still = simulate(base, hold(), np.zeros(1), node_arc_lengths(0.1, 201), solver=WORLD)[0, 0]
    heading = np.unwrap(np.arctan2(*np.diff(still[::-1], axis=0).T[::-1]))
    middle = np.linspace(0.0, 0.1, 200)[1:]
    curvature = np.interp(s, middle, np.abs(np.diff(heading)) / np.diff(middle)[0])
    size = np.sqrt(curvature**2 + 0.1**2) / 10.0
    rigidity = base.rigidity_at(s) * size ** (base.exponent - exponent)
    return CableModel(CABLE, rigidity, exponent, base.viscosity_n_m2_s)
