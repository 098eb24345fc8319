"""A cable with a rigid connector at its end: a clamped beam with a body at the tip."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, curve_fit

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.geometry import Cable, Connector, Motion
from cell.cable.model import CableModel
from cell.cable.solver import Solver

EI, RHO, LENGTH = 3e-5, 0.0074, 0.1
FINE = Solver(60, 1e-4, 1.0)
#: Light and heavy ones, beside a cable of 0.74 g.
CONNECTORS = {
    "light": Connector.rod(2e-4, 0.01),
    "heavy": Connector.rod(2e-3, 0.02),
    "dumbbell": Connector(5e-4, 0.03, 1.1e-7),
}


@pytest.fixture
def carrying(cable):
    """The cable of the tests with a connector."""
    return lambda connector: replace(cable, connector=connector)


def frequencies_hz(body: Connector) -> list[float]:
    """The lowest two of a clamped beam with a body at its end: centre d beyond it, inertia J.

    The kinetic energy M (w + d w′)²/2 + J w′²/2 of the body gives, at the end,
    EI w″ = ω² (M d (w + d w′) + J w′) and −EI w‴ = ω² M (w + d w′), of a shape
    w = A (cosh − cos) βx + B (sinh − sin) βx with β⁴ = ω² ρ/EI.
    """
    mass, d, inertia = body.mass_kg, body.length_m / 2, body.inertia_kg_m2

    def determinant(b: float) -> float:
        beta = b / LENGTH
        square = beta**4 * EI / RHO
        ch, c, sh, s = np.cosh(b), np.cos(b), np.sinh(b), np.sin(b)
        rows = []
        for w, slope, bend, shear in (
            (ch - c, sh + s, ch + c, sh - s),
            (sh - s, ch - c, sh + s, ch + c),
        ):
            turn = beta * slope
            centre = w + d * turn
            moment = EI * beta**2 * bend - square * (mass * d * centre + inertia * turn)
            rows.append((moment, -EI * beta**3 * shear - square * mass * centre))
        (m1, f1), (m2, f2) = rows
        return m1 * f2 - m2 * f1

    grid = np.linspace(0.05, 5.0, 2000)
    values = [determinant(b) for b in grid]
    roots = [
        brentq(determinant, grid[i], grid[i + 1], xtol=1e-13)
        for i in range(len(grid) - 1)
        if values[i] * values[i + 1] < 0.0
    ]
    return [(b / LENGTH) ** 2 * np.sqrt(EI / RHO) / (2 * np.pi) for b in roots[:2]]


def test_the_frequency_equation_has_the_textbooks_limits():
    nothing = Connector(1e-12, 1e-6, 1e-25)
    bare = np.array([1.8751, 4.6941]) ** 2 / LENGTH**2 * np.sqrt(EI / RHO) / (2 * np.pi)
    assert frequencies_hz(nothing) == pytest.approx(bare, rel=1e-4)
    heavy = Connector(1e-1, 1e-6, 1e-15)  # on a spring of 3 EI/L³ with 33/140 of the beam's mass
    moved = heavy.mass_kg + 33 / 140 * RHO * LENGTH
    spring = np.sqrt(3 * EI / LENGTH**3 / moved) / (2 * np.pi)
    assert frequencies_hz(heavy)[0] == pytest.approx(spring, rel=1e-5)


@pytest.mark.parametrize("name", CONNECTORS)
def test_it_swings_as_fast_as_the_frequency_equation_says(carrying, name):
    body = CONNECTORS[name]
    model = CableModel.uniform(carrying(body), EI, gravity_m_per_s2=(0.0, -1e-4))
    t = np.arange(0.0, 1.5, 1e-3)
    still = Motion(np.array([0.0, 1.0]), *np.zeros((3, 2)))
    tip = np.array([LENGTH + body.length_m])
    xy = simulate(model, still, t, tip, solver=FINE, start="straight", release_s=0.0)[0, :, 0]
    moved = xy[:, 1] - xy[0, 1]
    theory = frequencies_hz(body)
    scale = np.ptp(moved)

    def modes(t, f1, f2, a1, a2, mean):
        return mean + a1 * np.cos(2 * np.pi * f1 * t) + a2 * np.cos(2 * np.pi * f2 * t)

    begin = (*theory, 0.5 * scale, 0.01 * scale, moved.mean())
    sizes = (1, 1, scale, scale, scale)
    found, _ = curve_fit(modes, t, moved, p0=begin, x_scale=sizes, method="trf")
    assert found[:2] == pytest.approx(theory, rel=5e-4)


def test_at_rest_it_hangs_as_a_loaded_beam(carrying, at_rest):
    body, g = CONNECTORS["heavy"], 1e-3
    model = CableModel.uniform(carrying(body), EI, gravity_m_per_s2=(0.0, -g))
    tip, end = at_rest(model, np.array([LENGTH + body.length_m, LENGTH]), segments=60)
    q, load, d = RHO * g, body.mass_kg * g, body.length_m / 2
    droop = q * LENGTH**4 / 8 + load * LENGTH**3 / 3 + load * d * LENGTH**2 / 2
    slope = q * LENGTH**3 / 6 + load * LENGTH**2 / 2 + load * d * LENGTH
    assert -end[1] == pytest.approx(droop / EI, rel=5e-4)
    assert -tip[1] == pytest.approx((droop + body.length_m * slope) / EI, rel=5e-4)


def test_it_is_rigid_and_in_line_with_the_end_of_any_cable(carrying, at_rest):
    """Also of one that was gripped nearer to its end."""
    body = CONNECTORS["heavy"]
    places = LENGTH + body.length_m * np.array([1.0, 0.5, 0.0])
    for slip in (0.0, -0.02):
        effect = library()["grip_slip"].active(length_m=slip)
        model = CableModel.uniform(carrying(body), EI, effects=(effect,))
        far, middle, near = at_rest(model, places)
        assert np.linalg.norm(far - near) == pytest.approx(body.length_m, rel=1e-9)
        assert middle == pytest.approx(0.5 * (far + near))


def test_a_marker_beyond_the_connector_is_refused(carrying, at_rest):
    model = CableModel.uniform(carrying(CONNECTORS["light"]), EI)
    with pytest.raises(ValueError, match=r"must be 0 … 0\.11 m"):
        at_rest(model, np.array([0.12]))


def test_a_datasheet_with_a_connector_comes_back(carrying):
    cable = carrying(CONNECTORS["dumbbell"])
    assert Cable.from_dict(cable.to_dict()) == cable
    assert cable.length_m == pytest.approx(0.13)
    bare = replace(cable, connector=None)
    assert "connector" not in bare.to_dict()
    assert Cable.from_dict(bare.to_dict()) == bare
    assert bare.numbers["connector.mass_kg"] == 0.0
    with pytest.raises(ValueError, match=r"cable\.connector\.mass_kg"):
        Connector.rod(-1e-3, 0.01)
