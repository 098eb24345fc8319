"""Static shapes against an independent solution of the boundary-value problem."""

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from cell.cable.model import (
    REFERENCE_CURVATURE_1_PER_M,
    REGULAR_CURVATURE_1_PER_M,
    CableModel,
)


def heavy_elastica(model, clamp_angle):
    """x, y against s of dθ/ds = κ(M), dM/ds = −ρ g (L − s) cos θ; by collocation."""
    cable, n = model.cable, model.exponent
    weight = cable.line_density_kg_per_m * 9.81
    length = cable.free_length_m

    def curvature(moment, s):
        k = moment / model.rigidity_at(s)
        for _ in range(60):  # Newton for the inverse of the bending law
            g = (k**2 + REGULAR_CURVATURE_1_PER_M**2) / REFERENCE_CURVATURE_1_PER_M**2
            law = k * g ** ((n - 1) / 2)
            slope = g ** ((n - 1) / 2) * (
                1 + (n - 1) * k**2 / (k**2 + REGULAR_CURVATURE_1_PER_M**2)
            )
            k = k - (law - moment / model.rigidity_at(s)) / slope
        return k

    def ode(s, y):
        return np.array(
            [
                curvature(y[1], s),
                -weight * (length - s) * np.cos(y[0]),
                -np.cos(y[0]),
                -np.sin(y[0]),
            ]
        )

    def ends(a, b):
        return np.array([a[0] - clamp_angle, b[1], a[2], a[3]])

    s = np.linspace(0, length, 201)
    guess = np.array([clamp_angle + 4 * s, 3e-4 * (1 - s / length), -s, -0.3 * s])
    solution = solve_bvp(ode, ends, s, guess, tol=1e-9, max_nodes=20000)
    assert solution.success, solution.message
    return lambda at: solution.sol(at)[2:].T


@pytest.mark.parametrize(
    ("rigidity", "exponent", "angle"),
    [
        ([3e-5], 1.0, 0.0),
        ([1.5e-5], 1.0, -0.4),
        ([3.6e-5, 3e-5, 2.6e-5, 2.2e-5], 1.0, 0.3),
        ([3e-5], 1.3, 0.0),
        ([3e-5], 0.8, 0.0),
    ],
)
def test_heavy_elastica(cable, arc, at_rest, rigidity, exponent, angle):
    model = CableModel(cable, np.array(rigidity), exponent)
    exact = heavy_elastica(model, angle)(arc)
    coarse = at_rest(model, arc, angle)
    fine = at_rest(model, arc, angle, segments=240)
    assert np.abs(coarse - exact).max() < 2e-5
    assert np.abs(fine - exact).max() < 4e-7


def test_hanging_straight_down_is_an_equilibrium(cable, arc, at_rest):
    shape = at_rest(CableModel.uniform(cable, 3e-5), arc, np.pi / 2)
    assert shape == pytest.approx(np.stack([0 * arc, -arc], axis=1), abs=1e-9)
