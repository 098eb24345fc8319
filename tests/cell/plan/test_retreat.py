"""The hand backs out level before it rises, within its limits, and ends where it is sent."""

from __future__ import annotations

import numpy as np
import pytest

from cell.plan.paths import MotionLimits, retreat_path
from drivers.interfaces import Pose

LIMITS = MotionLimits()


def test_it_leaves_level_and_then_rises_to_the_goal() -> None:
    path = retreat_path(Pose(-0.05, -0.09), Pose(0.0, 0.0), LIMITS, 500.0)
    level = path.x_m < -1e-9
    np.testing.assert_allclose(path.y_m[level], -0.09, atol=1e-12)
    assert path.at(99.0) == Pose(pytest.approx(0.0, abs=1e-9), pytest.approx(0.0, abs=1e-9))
    speed = np.hypot(np.diff(path.x_m), np.diff(path.y_m)) * 500.0
    assert 0.1 < speed.max() <= LIMITS.velocity_m_per_s * 1.001


@pytest.mark.parametrize("end", [Pose(0.01, 0.0), Pose(0.0, 0.01)])
def test_one_stroke_is_enough_along_an_axis(end: Pose) -> None:
    path = retreat_path(Pose(0.0, 0.0), end, LIMITS, 500.0)
    last = path.at(99.0)
    assert (last.x_m, last.y_m) == pytest.approx((end.x_m, end.y_m), abs=1e-12)
    assert np.all(np.diff(path.t_s) > 0.0)


def test_what_is_no_retreat_is_refused() -> None:
    with pytest.raises(ValueError, match="no distance to go"):
        retreat_path(Pose(0.0, 0.0), Pose(0.0, 0.0), LIMITS, 500.0)
    with pytest.raises(ValueError, match="clamp angle must stay"):
        retreat_path(Pose(0.0, 0.0), Pose(0.1, 0.0, 0.5), LIMITS, 500.0)
