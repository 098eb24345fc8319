"""Joints along a path, looked at where it is fast."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import LimitError, Trajectory
from drivers.plane_mount import PlaneMount
from drivers.ur_kinematics import UR5E
from drivers.ur_reach import check_reach

BENT = np.array([0.1, -1.2, 1.3, -0.4, 0.5, 0.6])


def to_and_fro(rest_s: float, lasts_s: float) -> tuple[Trajectory, PlaneMount]:
    """0.1 m up and back, after a rest; in a plane through the hand at rest."""
    X = UR5E.forward(BENT)
    mount = PlaneMount(*(tuple(X[:3, k].tolist()) for k in (3, 0, 1)))
    t_s = np.arange(0.0, lasts_s, 0.002)
    y_m = 0.05 * (1.0 - np.cos(2.0 * np.pi * t_s / lasts_s))
    t_s, y_m = np.append(0.0, rest_s + t_s), np.append(0.0, y_m)
    return Trajectory(t_s, 0.0 * y_m, y_m, 0.0 * y_m), mount


@pytest.mark.parametrize("rest_s", [0.01, 10.0, 100.0])
def test_a_rest_in_a_path_hides_no_fast_joint(rest_s) -> None:
    path, mount = to_and_fro(rest_s, 2.0)
    check_reach(path, BENT, UR5E, np.eye(4), mount)
    path, mount = to_and_fro(rest_s, 0.1)
    with pytest.raises(LimitError, match=r"a joint turns at .* rad/s, allowed 3.14"):
        check_reach(path, BENT, UR5E, np.eye(4), mount)
