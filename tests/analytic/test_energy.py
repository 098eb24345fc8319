"""Energy is kept without damping and lost with it; forces are the slopes of the potential."""

import numpy as np
import pytest

from cell.cable import layout as at
from cell.cable.effects import library
from cell.cable.model import CableModel

EFFECTS = library()
CONSERVATIVE = (
    EFFECTS["added_mass"].active(kg_per_m=0.002, along=0.0),
    EFFECTS["tip_mass"].active(mass_kg=3e-5),
    EFFECTS["natural_curvature"].active(curvature_1_per_m=0.3, gradient_1_per_m2=3.0),
)


def drift(chain, model, step):
    """Largest change of energy in 1 s after letting go straight, per energy exchanged."""
    c = chain(model, step=step)
    start, potential = c.energy(), []
    energies = []
    for _ in range(40):
        c.run(round(0.025 / step))
        energies.append(c.energy())
        potential.append(c.potential(c[at.BEND]))
    return np.abs(np.array(energies) - start).max() / np.ptp(potential)


@pytest.mark.parametrize("exponent", [1.0, 1.2])
def test_energy_is_conserved_without_damping(cable, chain, exponent):
    model = CableModel(cable, np.array([3.5e-5, 2.5e-5]), exponent, 0.0, effects=CONSERVATIVE)
    coarse, fine = drift(chain, model, 4e-4), drift(chain, model, 1e-4)
    assert fine < 1e-3
    assert fine < 0.5 * coarse  # it vanishes with the step, so nothing is fed in or lost


def test_viscosity_takes_energy_all_the_time(cable, chain):
    c = chain(CableModel.uniform(cable, 3e-5, viscosity_n_m2_s=2e-7))
    energies = [c.energy()]
    for _ in range(100):
        c.run(20)
        energies.append(c.energy())
    assert np.all(np.diff(energies) < 0.0)
    c.run(4000)
    assert c.kinetic(c[at.BEND], c[at.RATE]) < 1e-4 * (energies[0] - energies[-1])


@pytest.mark.parametrize("exponent", [1.0, 1.2, 0.8])
def test_acceleration_is_the_slope_of_the_potential(cable, chain, exponent):
    model = CableModel(cable, np.array([3.5e-5, 2.5e-5]), exponent, effects=CONSERVATIVE)
    c = chain(model, angle=0.3)
    bend = np.random.default_rng(1).normal(0.03, 0.05, c.n + 1)
    bend[0] = 0.0  # the grip is rigid
    c[at.BEND][:] = bend
    acceleration = c.acceleration()[1:]
    unit = np.eye(c.n + 1)[1:]
    basis = [[c.kinetic(bend, a + b) for b in unit] for a in unit]
    single = np.array([c.kinetic(bend, a) for a in unit])
    mass = np.array(basis) - single[:, None] - single[None, :]
    h = 1e-6
    slope = [(c.potential(bend + h * e) - c.potential(bend - h * e)) / (2 * h) for e in unit]
    assert mass @ acceleration == pytest.approx(-np.array(slope), rel=1e-6, abs=1e-11)
