"""What is computed portion by portion must be what is computed at once."""

from __future__ import annotations

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.effects import library
from cell.cable.geometry import Cable, Motion
from cell.cable.live import SwingingCable
from cell.cable.model import CableModel
from cell.cable.solver import DivergedError, Solver

CABLE = Cable(0.1, 0.0074, 0.016, 1e-4)
ARC_M = np.linspace(0.1, 0.0, 61)
T_S = 0.002 * np.arange(400)
SOLVER = Solver(40, 0.75e-3)


def poses() -> np.ndarray:
    """Down by 50 mm in 0.3 s and a little to the left meanwhile."""
    u = np.clip((T_S - 0.1) / 0.3, 0.0, 1.0)
    way = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    return np.column_stack([-0.01 * way, -0.05 * way, 0.1 * way])


def in_portions(model: CableModel, sizes: list[int]) -> np.ndarray:
    cable, found, hand, first, k = SwingingCable(model, ARC_M, SOLVER), [], poses(), 0, 0
    while first < len(T_S):
        here = slice(first, first + sizes[k % len(sizes)])
        found.append(cable.advance(T_S[here], hand[here]))
        first, k = here.stop, k + 1
    return np.concatenate(found)


@pytest.fixture(scope="module")
def at_once() -> np.ndarray:
    motion = Motion(T_S, *poses().T)
    return simulate(model(), motion, T_S, ARC_M, solver=SOLVER)[0]


def model(**effects: dict[str, float]) -> CableModel:
    known = library()
    return CableModel.uniform(
        CABLE,
        3e-5,
        1.05,
        1e-7,
        effects=tuple(known[name].active(**values) for name, values in effects.items()),
    )


@pytest.mark.parametrize("sizes", [[1], [5], [7, 1, 2], [150]])
def test_the_cable_swings_as_if_all_had_been_known(at_once, sizes) -> None:
    swung = in_portions(model(), sizes)
    assert np.ptp(at_once[:, 0, 1]) > 0.05  # it does swing
    assert np.abs(swung - at_once).max() < 10e-6


def test_effects_are_shown_and_their_memory_is_kept() -> None:
    effects = {
        "bending_hysteresis": {"moment_n_m": 4e-6},
        "air_drag": {"drag_coefficient": 2.0},
        "camera_scale": {"factor": 1.02},
    }
    motion = Motion(T_S, *poses().T)
    expected = simulate(model(**effects), motion, T_S, ARC_M, solver=SOLVER)[0]
    swung = in_portions(model(**effects), [3])
    assert np.abs(swung - expected).max() < 10e-6
    assert np.abs(swung - in_portions(model(), [3])).max() > 1e-3


@pytest.mark.parametrize("name", ["camera_latency", "robot_lag"])
def test_an_effect_that_looks_at_other_times_is_refused(name) -> None:
    with pytest.raises(ValueError, match=rf"{name}.*leave it out"):
        SwingingCable(model(**{name: {"delay_s": 0.005}}), ARC_M)


def test_divergence_is_named() -> None:
    too_coarse = Solver(40, 0.05)
    with pytest.raises(DivergedError, match="diverged at t = "):
        cable = SwingingCable(model(), ARC_M, too_coarse)
        hand = 40.0 * poses()
        for k in range(0, len(T_S), 50):
            cable.advance(T_S[k : k + 50], hand[k : k + 50])
