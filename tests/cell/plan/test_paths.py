import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.cable.geometry import Motion
from cell.plan.paths import (
    MotionLimits,
    executed_motion,
    identification_path,
    insertion_path,
    path_to_rest,
    retreat_path,
)
from drivers.guard import ArmLimits, check_path
from drivers.interfaces import Pose, Trajectory

LIMITS = MotionLimits(velocity_m_per_s=0.4, acceleration_m_per_s2=3.0, jerk_m_per_s3=60.0)
START = Pose(0.3, 0.2, 0.05)
RATE_HZ = 500.0


def largest_derivatives(path: Trajectory) -> tuple[float, float, float]:
    dt = np.diff(path.t_s)[0]
    values = [np.column_stack([path.x_m, path.y_m])]
    for _ in range(3):
        values.append(np.diff(values[-1], axis=0) / dt)
    return tuple(float(np.abs(v).max()) for v in values[1:])  # type: ignore[return-value]


@pytest.mark.parametrize("offset_m", [0.0, 0.002, 0.04])
def test_insertion_goes_down_then_left_within_limits(offset_m: float) -> None:
    path = insertion_path(START, offset_m, 0.05, LIMITS, RATE_HZ)
    assert (path.x_m[0], path.y_m[0]) == (START.x_m, START.y_m)
    assert path.x_m[-1] == pytest.approx(START.x_m - 0.05, abs=1e-9)
    assert path.y_m[-1] == pytest.approx(START.y_m - offset_m, abs=1e-9)
    assert np.all(path.angle_rad == START.angle_rad)
    np.testing.assert_allclose(np.diff(path.t_s), 1.0 / RATE_HZ)
    going_left = path.x_m < START.x_m - 1e-12
    np.testing.assert_allclose(path.y_m[going_left], START.y_m - offset_m, atol=1e-9)
    speed, acceleration, jerk = largest_derivatives(path)
    assert speed <= LIMITS.velocity_m_per_s * 1.001
    assert acceleration <= LIMITS.acceleration_m_per_s2 * 1.001
    assert jerk <= LIMITS.jerk_m_per_s3 * 1.01


def test_identification_takes_the_time_asked_for_and_holds() -> None:
    path = identification_path(START, 0.05, MotionLimits(), RATE_HZ)
    moving = np.abs(path.y_m - path.y_m[-1]) > 1e-9
    assert path.t_s[np.flatnonzero(moving)[-1]] == pytest.approx(0.3, abs=0.01)
    assert path.t_s[-1] == pytest.approx(1.3, abs=0.01)
    assert path.y_m[-1] == pytest.approx(START.y_m - 0.05, abs=1e-9)


def test_identification_takes_longer_when_the_limits_ask() -> None:
    slow = MotionLimits(velocity_m_per_s=0.1, acceleration_m_per_s2=1.0, jerk_m_per_s3=20.0)
    path = identification_path(START, 0.05, slow, RATE_HZ, hold_s=0.0)
    assert path.t_s[-1] > 0.5
    assert largest_derivatives(path)[0] <= 0.1001


@pytest.mark.parametrize("speed", np.linspace(0.01, 1.0, 100))
def test_limits_that_are_reached_at_the_same_moment_are_no_trouble(speed: float) -> None:
    """20 mm are just enough to reach acceleration and half the speed: rounding decides the rest."""
    gentle = MotionLimits(0.2, 1.0, 10.0).slowed(1.0 / speed)
    path = insertion_path(Pose(0.0, -0.05), 0.02, 0.05, gentle, 50.0)
    assert path.y_m[-1] == pytest.approx(-0.07, abs=1e-9)
    assert path.t_s[-1] * speed == pytest.approx(0.95, abs=0.05)


def test_executed_motion_follows_late_by_the_lag_and_arrives() -> None:
    path = insertion_path(START, 0.02, 0.05, LIMITS, RATE_HZ)
    motion = executed_motion(path, 0.03, settle_s=0.2)
    assert motion.t_s[0] == 0.0
    assert motion.t_s[-1] > path.t_s[-1] + 0.2
    assert motion.x_m[-1] == pytest.approx(path.x_m[-1], abs=1e-6)
    half_way = START.x_m - 0.025
    late_s = np.interp(-half_way, -motion.x_m, motion.t_s) - np.interp(
        -half_way, -path.x_m, path.t_s
    )
    assert late_s == pytest.approx(0.03, rel=0.05)


def test_executed_motion_continues_a_history() -> None:
    path = insertion_path(START, 0.01, 0.05, LIMITS, RATE_HZ)
    t = np.array([-1.3, -1.0, 0.0])
    ys = np.array([0.25, 0.2, 0.2])
    history = Motion(t, np.full(3, 0.3), ys, np.full(3, 0.05))
    motion = executed_motion(path, 0.03, history=history)
    assert motion.t_s[0] == -1.3
    np.testing.assert_allclose(np.interp(t, motion.t_s, motion.y_m), ys)


@pytest.mark.parametrize(
    "call",
    [
        lambda: insertion_path(START, -0.001, 0.05, LIMITS, RATE_HZ),
        lambda: insertion_path(START, 0.0, 0.0, LIMITS, RATE_HZ),
        lambda: insertion_path(START, 0.0, 0.05, LIMITS, 0.0),
        lambda: identification_path(START, 0.0, LIMITS, RATE_HZ),
        lambda: MotionLimits(velocity_m_per_s=0.0),
        lambda: MotionLimits(jerk_m_per_s3=float("nan")),
    ],
)
def test_impossible_requests_are_refused(call) -> None:
    with pytest.raises(ValueError, match=r"must be|≥|finite"):
        call()


BRISK = MotionLimits()
ALLOWED = ArmLimits(-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 0.6, 6.0, 250.0)
PATH = insertion_path(Pose(0.0, -0.05), 0.02, 0.05, MotionLimits(0.2, 1.0, 10.0), 500.0)


@given(st.floats(0.0, float(PATH.t_s[-1]) - 0.006))
def test_it_is_the_path_until_then_and_rests_soon_after(from_s: float) -> None:
    stopped = path_to_rest(PATH, from_s, BRISK)
    same = int(np.searchsorted(PATH.t_s, from_s))
    np.testing.assert_array_equal(stopped.x_m[:same], PATH.x_m[:same])
    np.testing.assert_array_equal(stopped.y_m[:same], PATH.y_m[:same])
    assert stopped.t_s[-1] < from_s + 0.15
    check_path(stopped, ALLOWED)
    assert stopped.x_m.min() >= PATH.x_m.min() - 1e-6


def test_what_has_ended_is_not_left() -> None:
    with pytest.raises(ValueError, match="the path ends"):
        path_to_rest(PATH, float(PATH.t_s[-1]) + 0.1, BRISK)


@pytest.mark.parametrize("from_s", np.arange(0.02, 0.4, 0.02))
def test_a_hand_never_goes_back_though_the_path_is_brisker_than_the_limits(from_s: float) -> None:
    brisk = MotionLimits(0.5, 5.0, 200.0)
    gentle = MotionLimits(0.3, 1.0, 20.0)
    path = insertion_path(Pose(0.0, -0.05), 0.02, 0.05, brisk, 500.0)
    stopped = path_to_rest(path, min(from_s, float(path.t_s[-1]) - 0.006), gentle)
    assert np.diff(stopped.x_m).max() < 1e-5
    assert np.diff(stopped.y_m).max() < 1e-5
    check_path(stopped, ALLOWED)


def test_it_leaves_level_and_then_rises_to_the_goal() -> None:
    path = retreat_path(Pose(-0.05, -0.09), Pose(0.0, 0.0), BRISK, 500.0)
    level = path.x_m < -1e-9
    np.testing.assert_allclose(path.y_m[level], -0.09, atol=1e-12)
    assert path.at(99.0) == Pose(pytest.approx(0.0, abs=1e-9), pytest.approx(0.0, abs=1e-9))
    speed = np.hypot(np.diff(path.x_m), np.diff(path.y_m)) * 500.0
    assert 0.1 < speed.max() <= BRISK.velocity_m_per_s * 1.001


@pytest.mark.parametrize("end", [Pose(0.01, 0.0), Pose(0.0, 0.01)])
def test_one_stroke_is_enough_along_an_axis(end: Pose) -> None:
    path = retreat_path(Pose(0.0, 0.0), end, BRISK, 500.0)
    last = path.at(99.0)
    assert (last.x_m, last.y_m) == pytest.approx((end.x_m, end.y_m), abs=1e-12)
    assert np.all(np.diff(path.t_s) > 0.0)


def test_what_is_no_retreat_is_refused() -> None:
    with pytest.raises(ValueError, match="no distance to go"):
        retreat_path(Pose(0.0, 0.0), Pose(0.0, 0.0), BRISK, 500.0)


def test_it_turns_last_in_place_and_within_its_limits() -> None:
    path = retreat_path(Pose(-0.05, -0.09, 0.6), Pose(0.0, 0.0, -0.2), BRISK, 500.0)
    turning = np.abs(path.angle_rad - 0.6) > 1e-9
    assert turning[-1] and not turning[0]
    np.testing.assert_allclose(path.x_m[turning], 0.0, atol=1e-9)
    np.testing.assert_allclose(path.y_m[turning], 0.0, atol=1e-9)
    assert path.angle_rad[-1] == pytest.approx(-0.2, abs=1e-9)
    for order, limit in (
        (1, BRISK.velocity_rad_per_s),
        (2, BRISK.acceleration_rad_per_s2),
    ):
        size = np.abs(np.diff(path.angle_rad, order)) * 500.0**order
        assert 0.5 * limit < size.max() <= 1.01 * limit


def test_a_hand_turned_by_less_than_matters_is_not_turned() -> None:
    path = retreat_path(Pose(0.0, 0.0, 5e-4), Pose(0.01, 0.0), BRISK, 500.0)
    assert np.all(path.angle_rad == 5e-4)


def test_slowed_limits_give_the_same_path_in_so_many_times_the_time() -> None:
    start, end = Pose(0.0, 0.0, 0.3), Pose(0.02, -0.03, 0.0)
    fast = retreat_path(start, end, BRISK, 2000.0)
    slow = retreat_path(start, end, BRISK.slowed(4.0), 500.0)
    assert len(slow.t_s) == pytest.approx(len(fast.t_s), abs=1)
    n = min(len(slow.t_s), len(fast.t_s))
    np.testing.assert_allclose(slow.x_m[:n], fast.x_m[:n], atol=1e-9)
    np.testing.assert_allclose(slow.angle_rad[:n], fast.angle_rad[:n], atol=1e-9)
