"""The last time of a simulation is simulated too, whatever rounding does to it."""

from __future__ import annotations

import numpy as np

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver


def test_a_last_time_that_rounds_beyond_the_last_step_is_not_left_unwritten() -> None:
    solver = Solver()
    model = CableModel(Cable(0.1, 0.0074, 0.016, 1e-4), np.array([3e-5]), 1.0, 1e-7)
    rest = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))
    end_s = 40 * solver.step_s
    for last_s in (end_s, np.nextafter(end_s, 1.0), end_s + 1e-13):
        tip_m = simulate(model, rest, np.array([0.0, last_s]), np.array([0.1]), solver=solver)[0]
        np.testing.assert_allclose(tip_m[1], tip_m[0], atol=1e-6)
