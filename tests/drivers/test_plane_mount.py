from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.interfaces import Pose
from drivers.plane_mount import PlaneMount

MOUNT = PlaneMount((0.45, -0.12, 0.38), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))


def test_axes_and_origin() -> None:
    X = MOUNT.to_base(Pose(0.1, -0.05, 0.0))
    assert X[:3, 3] == pytest.approx([0.45, -0.22, 0.33])
    assert X[:3, 0] == pytest.approx([0.0, -1.0, 0.0])
    assert X[:3, 2] == pytest.approx(np.cross([0.0, -1.0, 0.0], [0.0, 0.0, 1.0]))


def test_a_positive_angle_points_the_cable_down() -> None:
    """The cable leaves towards the tool's −x; at a positive clamp angle that has to sink."""
    leaves = -MOUNT.to_base(Pose(0.0, 0.0, 0.2))[:3, 0]
    assert leaves[2] == pytest.approx(-np.sin(0.2))


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3, 3))
def test_there_and_back(x, y, angle) -> None:
    there = MOUNT.to_base(Pose(x, y, angle))
    back = MOUNT.to_plane(there)
    assert (back.x_m, back.y_m, back.angle_rad) == pytest.approx((x, y, angle), abs=1e-12)
    assert MOUNT.off_plane(there) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_off_the_plane() -> None:
    X = MOUNT.to_base(Pose(0.0, 0.0))
    X[:3, 3] += 0.012 * X[:3, 2]
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]]
    assert MOUNT.off_plane(X @ tilt) == pytest.approx((0.012, 0.1))


@pytest.mark.parametrize("y_axis", [(0.0, 0.1, 1.0), (0.0, 0.0, 0.0), (0.0, 2.0, 0.0)])
def test_axes_must_be_at_right_angles(y_axis) -> None:
    with pytest.raises(ValueError, match="must be at right angles"):
        PlaneMount((0.0, 0.0, 0.0), (0.0, -1.0, 0.0), y_axis)
