"""Order of convergence, measured; and the error of the default mesh and step."""

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.model import CableModel
from cell.cable.solver import Solver

TIMES = np.arange(0.0, 1.2, 0.01)


def distance(a, b):
    """Root mean square distance of the nodes, m."""
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=-1))))


def test_second_order_in_time(cable, arc, jerk):
    model = CableModel(cable, np.array([3.5e-5, 2.5e-5]), 1.1, 1e-7)
    run = [simulate(model, jerk, TIMES, arc, solver=Solver(12, h)) for h in (2e-3, 1e-3, 5e-4)]
    order = np.log2(distance(run[0], run[1]) / distance(run[1], run[2]))
    assert order == pytest.approx(2.0, abs=0.1)


def test_at_least_second_order_in_space(cable, arc, jerk):
    model = CableModel(cable, np.array([3.5e-5, 2.5e-5]), 1.1, 1e-7)
    run = [simulate(model, jerk, TIMES, arc, solver=Solver(n, 5e-4)) for n in (15, 30, 60)]
    order = np.log2(distance(run[0], run[1]) / distance(run[1], run[2]))
    assert order > 1.9


@pytest.mark.parametrize(
    ("rigidity", "exponent", "viscosity"),
    [([3e-5], 1.0, 1e-7), ([1.8e-5], 1.0, 7e-8), ([3.6e-5, 3e-5, 2.2e-5], 1.13, 1e-7)],
)
def test_default_error_is_below_a_fiftieth_of_a_millimetre(
    cable, arc, jerk, rigidity, exponent, viscosity
):
    model = CableModel(cable, np.array(rigidity), exponent, viscosity)
    default = simulate(model, jerk, TIMES, arc)[0]
    converged = simulate(model, jerk, TIMES, arc, solver=Solver(160, 2e-4))[0]
    assert np.linalg.norm(default - converged, axis=-1).max() < 2e-5


@pytest.mark.parametrize("curvature", [0.05, 0.01])
def test_friction_that_turns_within_a_step_is_followed_by_coarse_steps(cable, arc, jerk, curvature):
    friction = library()["bending_hysteresis"].active(moment_n_m=4e-5, curvature_1_per_m=curvature)
    model = CableModel(cable, np.array([3e-5]), 1.0, 1e-7, effects=(friction,))
    coarse = simulate(model, jerk, TIMES, arc, solver=Solver(24, 1.5e-3))[0]
    fine = simulate(model, jerk, TIMES, arc, solver=Solver(24, 1e-4))[0]
    assert np.linalg.norm(coarse - fine, axis=-1).max() < 5e-5
