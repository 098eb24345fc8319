"""How long a cable swings on is what a closed form says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.geometry import Cable, Motion
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.plan.rest import time_to_rest_s

SPACE = ParameterSpace.of(Cable(0.1, 0.0074, 0.016, 0.0001))


def cable(damping: float = 1.0) -> Identified:
    mean = SPACE.start(3e-5)
    values = SPACE.natural(mean)
    mean[SPACE.names.index("viscosity")] += np.log(damping)
    assert values[SPACE.names.index("viscosity")] > 0.0
    none = np.zeros((len(mean), len(mean)))
    return Identified(SPACE, mean, none, Noise(3e-5), 3e-5, 1.0, 9, 9, 1, "map", none)


@pytest.fixture
def jerked() -> Motion:
    t_s = np.arange(0.0, 0.8, 0.002)
    u = np.clip((t_s - 0.2) / 0.3, 0.0, 1.0)
    return Motion(t_s, 0 * t_s, -0.05 * u**3 * (10 - 15 * u + 6 * u**2), 0 * t_s)


def test_a_swing_decays_exponentially(jerked: Motion) -> None:
    """Ten times nearer takes ln 10 time constants, each time."""
    times_s = [time_to_rest_s(cable(), jerked, within_m, 60.0) for within_m in (1e-3, 1e-4, 1e-5)]
    assert 0.5 < times_s[0] < times_s[1] < times_s[2] < 60.0
    assert np.diff(times_s)[1] == pytest.approx(np.diff(times_s)[0], rel=0.15)


def test_the_noise_of_a_log_does_not_swing_on(jerked: Motion) -> None:
    """Its hand was led to a place half a minute away by a curve that bulged by 0.08 mm."""
    rng = np.random.default_rng(1)
    noisy = replace(jerked, y_m=jerked.y_m + rng.normal(scale=1e-5, size=jerked.y_m.shape))
    told = [time_to_rest_s(cable(), motion, 5e-5, 30.0) for motion in (jerked, noisy)]
    assert told[1] == pytest.approx(told[0], abs=0.5)


def test_twice_the_viscosity_half_the_time(jerked: Motion) -> None:
    light, heavy = (time_to_rest_s(cable(d), jerked, 5e-5, 60.0) for d in (1.0, 2.0))
    assert heavy == pytest.approx(0.5 * light, rel=0.2)


def test_what_swings_longer_than_is_asked_for(jerked: Motion) -> None:
    assert time_to_rest_s(cable(0.01), jerked, 1e-6, 5.0) == pytest.approx(5.0, abs=0.2)


def test_a_cable_that_was_not_moved_rests() -> None:
    still = Motion(np.array([0.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))
    assert time_to_rest_s(cable(), still, 1e-5, 5.0) == 0.0
