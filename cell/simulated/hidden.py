"""Hidden cables: the individuals of a simulated batch, which the cell must find out."""

from __future__ import annotations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.dynamics import simulate
from cell.cable.effects import library, unscreened
from cell.cable.geometry import Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.settings import Settings
from cell.settings.translate import cable_of
from drivers.interfaces import Trajectory
from drivers.sim.world import CableShape

#: Knots of the simulated cables' flexural rigidity; more than the model has.
HIDDEN_KNOTS = 13
#: First eigenvalue β₁L of a clamped beam.
FIRST_MODE = 1.8751


def hidden_cable(settings: Settings, seed: int, number: int) -> CableModel:
    """The `number`-th individual of a simulated batch: what the cell must find out.

    Its rigidity varies along the cable, its exponent is not 1; both come from the seed alone.
    """
    truth, known = settings.world, library() | unscreened()
    rng = np.random.default_rng([seed, number])
    low, high = np.log(truth.rigidity_n_m2)
    rigidity = float(np.exp(rng.uniform(low, high)))
    s = np.linspace(0.0, 1.0, HIDDEN_KNOTS)
    waves = sum(
        rng.normal(scale=1.0 / k) * np.cos(np.pi * k * s + rng.uniform(0.0, 2.0 * np.pi))
        for k in (1, 2, 3)
    )
    profile = rigidity * np.exp(truth.rigidity_variation * waves)
    cable = cable_of(settings)
    stiffness = rigidity / (cable.line_density_kg_per_m * cable.free_length_m**4)
    first_mode_rad_per_s = FIRST_MODE**2 * float(np.sqrt(stiffness))
    damping_ratio = rng.uniform(*truth.damping_ratio)
    return CableModel(
        cable,
        profile,
        exponent=float(rng.uniform(*truth.exponent)),
        viscosity_n_m2_s=float(2.0 * damping_ratio * rigidity / first_mode_rad_per_s),
        effects=tuple(known[name].active(**v) for name, v in truth.effects.items()),
    )


def cable_shape(model: CableModel, segments: int) -> CableShape:
    """The simulated world's cable: shapes (Q, segments + 1, 2) at times, tip first."""
    arc_length_m = np.linspace(model.cable.length_m, 0.0, segments + 1)
    solver = Solver(segments=segments)

    def shape(grip: Trajectory, query_s: FloatArray) -> FloatArray:
        motion = Motion(grip.t_s, grip.x_m, grip.y_m, grip.angle_rad)
        shapes: FloatArray = simulate(model, motion, query_s, arc_length_m, solver=solver)[0]
        return shapes

    return shape
