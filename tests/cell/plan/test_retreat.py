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


def test_it_turns_last_in_place_and_within_its_limits() -> None:
    path = retreat_path(Pose(-0.05, -0.09, 0.6), Pose(0.0, 0.0, -0.2), LIMITS, 500.0)
    turning = np.abs(path.angle_rad - 0.6) > 1e-9
    assert turning[-1] and not turning[0]
    np.testing.assert_allclose(path.x_m[turning], 0.0, atol=1e-9)
    np.testing.assert_allclose(path.y_m[turning], 0.0, atol=1e-9)
    assert path.angle_rad[-1] == pytest.approx(-0.2, abs=1e-9)
    for order, limit in ((1, LIMITS.velocity_rad_per_s), (2, LIMITS.acceleration_rad_per_s2)):
        size = np.abs(np.diff(path.angle_rad, order)) * 500.0**order
        assert 0.5 * limit < size.max() <= 1.01 * limit


def test_a_hand_turned_by_less_than_matters_is_not_turned() -> None:
    path = retreat_path(Pose(0.0, 0.0, 5e-4), Pose(0.01, 0.0), LIMITS, 500.0)
    assert np.all(path.angle_rad == 5e-4)


def test_slowed_limits_give_the_same_path_in_so_many_times_the_time() -> None:
    start, end = Pose(0.0, 0.0, 0.3), Pose(0.02, -0.03, 0.0)
    fast = retreat_path(start, end, LIMITS, 2000.0)
    slow = retreat_path(start, end, LIMITS.slowed(4.0), 500.0)
    assert len(slow.t_s) == pytest.approx(len(fast.t_s), abs=1)
    n = min(len(slow.t_s), len(fast.t_s))
    np.testing.assert_allclose(slow.x_m[:n], fast.x_m[:n], atol=1e-9)
    np.testing.assert_allclose(slow.angle_rad[:n], fast.angle_rad[:n], atol=1e-9)
