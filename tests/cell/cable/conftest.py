"""The paper's cable and motions, for the tests of the engine."""

from __future__ import annotations

import numpy as np
import pytest

from cell.cable.geometry import Cable, Motion


@pytest.fixture
def cable() -> Cable:
    return Cable(0.1, 0.0074, 0.016, 1e-4)


@pytest.fixture
def arc() -> np.ndarray:
    return np.linspace(0.0, 0.1, 11)


@pytest.fixture
def jerk() -> Motion:
    """50 mm down in 0.3 s, least jerk, sampled at 500 Hz."""
    t = np.arange(0.0, 0.8, 0.002)
    x = np.clip((t - 0.1) / 0.3, 0.0, 1.0)
    return Motion(t, 0 * t, -0.05 * x**3 * (10 - 15 * x + 6 * x**2), 0 * t)
