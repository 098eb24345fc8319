from dataclasses import replace

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion, node_arc_lengths
from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.identify.fit import FitError
from cell.identify.paper import fit_as_paper, rigidity, still_shape
from cell.study.data import Markers

GRAVITY = (0.0, -9.81)
NODES_M = node_arc_lengths(0.1)


def nodes_at_rest(model: CableModel, angle_rad: float = 0.0) -> np.ndarray:
    still = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.full(2, angle_rad))
    solver = Solver(segments=120)
    nodes: np.ndarray = simulate(model, still, np.zeros(1), NODES_M, solver=solver)[0, 0]
    return nodes


@pytest.mark.parametrize("exponent", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("angle_rad", [0.0, 0.3])
def test_rigidity_of_a_converged_shape(
    flat_cable: Cable, exponent: float, angle_rad: float
) -> None:
    """From nodes without noise: within the error of ten segments wherever it is determined."""
    truth = CableModel(flat_cable, np.array([3.2e-5, 3e-5, 2.6e-5, 2.4e-5]), exponent)
    shape = still_shape(nodes_at_rest(truth, angle_rad), angle_rad, flat_cable, GRAVITY, 1e-9)
    found = rigidity(shape, exponent)
    s = np.linspace(0.0, 0.1, 11)
    np.testing.assert_allclose(found[:8], truth.rigidity_at(s[:8]), rtol=0.05)


def test_moments_are_those_of_the_weight_beyond(flat_cable: Cable) -> None:
    """A level cable: ρ g (L − s)²/2 at every hinge."""
    level = np.stack([-NODES_M, np.zeros(11)], axis=-1)
    shape = still_shape(level, 0.0, flat_cable, GRAVITY, 1e-9)
    exact = 0.5 * 0.0074 * 9.81 * (0.1 - shape.arc_length_m) ** 2
    np.testing.assert_allclose(shape.moment_n_m[:-1], exact[:-1], rtol=1e-9)
    third = 0.5 * 0.0074 * 9.81 * (0.1 - 0.01 / 3.0) ** 2  # where the first half segment bends
    assert shape.moment_n_m[-1] == pytest.approx(third, rel=5e-3)


def test_near_the_tip_the_noise_decides_and_the_neighbour_is_taken(flat_cable: Cable) -> None:
    truth = CableModel(flat_cable, np.array([3e-5]))
    nodes = nodes_at_rest(truth)
    noisy = nodes + 1e-4 * np.random.default_rng(0).normal(size=nodes.shape)
    shape = still_shape(noisy, 0.0, flat_cable, GRAVITY, 1e-4)
    assert not shape.determined[0]
    assert shape.determined[-1]
    found = rigidity(shape, 1.0)
    first = 10 - int(np.argmax(shape.determined))  # knots from the grip that are determined
    np.testing.assert_array_equal(found[first:], found[first - 1])


def test_paper_finds_exponent_viscosity_and_rigidity(measure, flat_cable: Cable) -> None:
    truth = CableModel(flat_cable, np.array([3e-5]), 1.05, 1.5e-7)
    world = measure(truth, seed=1, noise_m=2e-5)
    found = fit_as_paper(world.trial, NODES_M, flat_cable, GRAVITY)
    assert found.method == "paper"
    assert found.space.knots == 11
    assert found.values[-2] == pytest.approx(1.05, abs=0.03)
    assert found.values[-1] == pytest.approx(1.5e-7, rel=0.1)
    s = np.linspace(0.0, 0.05, 6)
    np.testing.assert_allclose(found.model.rigidity_at(s), 3e-5, rtol=0.15)
    low, high = found.interval()
    assert np.mean((low[:6] < 3e-5) & (high[:6] > 3e-5)) > 0.6


def test_what_the_paper_cannot_do_is_said(measure, flat_cable: Cable) -> None:
    world = measure(CableModel(flat_cable, np.array([3e-5]), 1.0, 1.5e-7), seed=2)
    with pytest.raises(FitError, match="equal distances"):
        fit_as_paper(world.trial, NODES_M**1.1, flat_cable, GRAVITY)
    straight = world.trial.markers.xy_m.copy()
    straight[:60, :, 1] = 0.0
    unbent = replace(world.trial, markers=Markers(world.trial.markers.t_s, straight))
    with pytest.raises(FitError, match=r"hardly bends|noise"):
        fit_as_paper(unbent, NODES_M, flat_cable, GRAVITY)
