from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from drivers.guard import (
    ArmLimits,
    CameraLimits,
    GripperLimits,
    GuardedArm,
    GuardedCamera,
    GuardedGripper,
    check_path,
)
from drivers.interfaces import (
    Arm,
    ArmMode,
    Camera,
    CameraError,
    Gripper,
    LimitError,
    StoppedError,
    Trajectory,
)
from drivers.sim.camera import CameraFaults

LIMITS = ArmLimits(
    x_min_m=0.0,
    x_max_m=1.0,
    y_min_m=0.0,
    y_max_m=1.0,
    angle_min_rad=-0.2,
    angle_max_rad=0.2,
    max_speed_m_per_s=0.5,
    max_acceleration_m_per_s2=5.0,
    max_jerk_m_per_s3=200.0,
)


def points(**columns: list[float]) -> Trajectory:
    count = len(next(iter(columns.values())))
    default = {"x_m": np.full(count, 0.5), "y_m": np.full(count, 0.5), "angle_rad": np.zeros(count)}
    given = {k: np.array(v) for k, v in columns.items()}
    return Trajectory(**{"t_s": np.arange(count) * 1.0, **default, **given})


@pytest.fixture
def guarded(cell) -> GuardedArm:
    return GuardedArm(cell.arm, LIMITS)


def test_guards_have_the_shape_of_what_they_guard(cell, guarded) -> None:
    assert isinstance(guarded, Arm)
    assert isinstance(GuardedGripper(cell.gripper, GripperLimits(5.0, 50.0)), Gripper)
    assert isinstance(GuardedCamera(cell.camera, cell.clock), Camera)


def test_names_the_point_the_value_and_the_limit(guarded) -> None:
    with pytest.raises(LimitError) as error:
        guarded.follow(points(y_m=[0.5, 0.5, -0.2, 0.5, 0.5]))
    assert str(error.value) == (
        "arm: point 3 of 5 has y = -0.2000 m, allowed 0.0000..1.0000 m; this path was not begun; "
        "the gripper is at x = 0.5000 m, y = 0.5000 m, angle = 0.0000 rad"
    )


def test_what_rounding_and_an_arms_noise_add_at_a_limit_is_tolerated() -> None:
    """A pose may exceed its range by 0.1 mm or 1 mrad, and by no more."""
    check_path(points(x_m=[0.5, 1.0 + 0.99e-4]), LIMITS)
    check_path(points(y_m=[0.5, -0.99e-4]), LIMITS)
    check_path(points(angle_rad=[0.0, 0.2 + 0.99e-3]), LIMITS)
    with pytest.raises(LimitError, match=r"x = 1.0001 m, allowed 0.0000..1.0000 m"):
        check_path(points(x_m=[0.5, 1.0 + 1.01e-4]), LIMITS)
    with pytest.raises(LimitError, match=r"angle = -0.2010 rad"):
        check_path(points(angle_rad=[0.0, -0.2 - 1.01e-3]), LIMITS)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (points(x_m=[0.5, 1.01]), r"point 2 of 2 has x = 1.0100 m"),
        (points(angle_rad=[0.0, 0.3]), r"point 2 of 2 has angle = 0.3000 rad, allowed -0.2000"),
        (points(x_m=[0.5, np.nan, 0.5]), r"point 2 of 3 has x = nan"),
        (points(t_s=[0.0, np.inf]), r"point 2 of 2 has t = inf"),
        (points(t_s=[0.0, 1.0, 1.0]), r"point 3 of 3 has t = 1.000000 s, not later than 1.000000"),
        (points(x_m=[0.5]), r"1 points, at least 2"),
        (points(x_m=[0.5, 0.5], y_m=[0.5, 0.5, 0.5]), r"y has shape \(3,\), t \(2,\)"),
    ],
)
def test_refuses_what_cannot_be_followed(path, message) -> None:
    with pytest.raises(LimitError, match=message):
        check_path(path, LIMITS)


def test_a_path_is_checked_against_the_limits_without_being_sent(guarded, line, cell) -> None:
    with pytest.raises(LimitError, match=r"speed = .*nothing was moved"):
        guarded.check(line(dy_m=-0.2, duration_s=0.5))
    guarded.check(line(dy_m=-0.02, duration_s=1.0))
    assert cell.world.gripper_rest_from_s() <= cell.clock.now_s()


def test_a_path_must_start_where_the_arm_is(guarded, line, cell) -> None:
    with pytest.raises(LimitError, match=r"starts at x = 0.5020 m, but the arm is at 0.5000 m"):
        guarded.follow(line(start=replace(cell.world.gripper_pose(), x_m=0.502)))
    assert cell.world.gripper_rest_from_s() == 0.0
    guarded.follow(line(dx_m=-0.05))
    assert cell.world.gripper_rest_from_s() > 0.4


def peaks(duration_s: float) -> tuple[float, float, float]:
    """Largest speed, acceleration and jerk of `line` over 50 mm, analytically."""
    v = 0.05 * 1.875 / duration_s
    a = 0.05 * (10.0 / np.sqrt(3.0)) / duration_s**2
    j = 0.05 * 60.0 / duration_s**3
    return v, a, j


@pytest.mark.parametrize(("order", "short"), [(0, 0.98), (1, 0.97), (2, 0.88)])
def test_speed_acceleration_and_jerk_are_judged_by_their_peaks(line, order, short) -> None:
    """A limit at the analytic peak passes, one a little below it does not; jerk peaks briefly."""
    peak = peaks(0.4)[order]
    names = ["max_speed_m_per_s", "max_acceleration_m_per_s2", "max_jerk_m_per_s3"]
    loose = dict.fromkeys(names, 1e9)
    check_path(line(dx_m=-0.05), replace(LIMITS, **loose | {names[order]: peak}))
    label = ["speed", "acceleration", "jerk"][order]
    with pytest.raises(LimitError, match=rf"has {label} = "):
        check_path(line(dx_m=-0.05), replace(LIMITS, **loose | {names[order]: short * peak}))


def test_rounded_times_are_not_taken_for_jerk(line) -> None:
    """Times to the microsecond, as a recorded path has them, change jerk by < 10 %."""
    exact = line(dx_m=-0.05)
    rng = np.random.default_rng(0)
    rounded = Trajectory(
        exact.t_s + rng.uniform(-5e-7, 5e-7, len(exact.t_s)), exact.x_m, exact.y_m, exact.angle_rad
    )
    jerk = peaks(0.4)[2]
    check_path(rounded, replace(LIMITS, max_jerk_m_per_s3=1.1 * jerk))
    with pytest.raises(LimitError, match="jerk"):
        check_path(rounded, replace(LIMITS, max_jerk_m_per_s3=0.9 * jerk))


def test_a_path_that_starts_with_a_jump_of_speed_is_refused(line) -> None:
    whole = line(dx_m=-0.05)
    cut = Trajectory(*(v[60:] for v in (whole.t_s, whole.x_m, whole.y_m, whole.angle_rad)))
    limits = replace(LIMITS, max_jerk_m_per_s3=1e9)
    check_path(whole, limits)
    with pytest.raises(LimitError, match=r"point 1 of 141 has acceleration"):
        check_path(cut, limits)


def test_turning_is_limited_too(line) -> None:
    check_path(line(dangle_rad=0.1), LIMITS)
    with pytest.raises(LimitError, match="angular speed"):
        check_path(line(dangle_rad=0.1), replace(LIMITS, max_angular_speed_rad_per_s=0.3))


def test_a_stopped_arm_stays_stopped_behind_its_guard(guarded, line) -> None:
    guarded.stop("operator")
    with pytest.raises(StoppedError, match="operator"):
        guarded.follow(line())
    guarded.reset()
    guarded.follow(line())


def test_a_changed_path_is_judged_as_a_whole(guarded, line, cell) -> None:
    """It keeps the limits, also where it leaves the present path, and is that one until then."""
    guarded.connect()
    path = line(dy_m=0.02, duration_s=0.5, start=guarded.state().pose)
    start_s = cell.clock.now_s() + 0.1
    with pytest.raises(LimitError, match="follows no path"):
        guarded.revise(path, start_s)
    guarded.follow(path, start_s)
    u = np.clip((path.t_s - 0.3) / 0.15, 0.0, 1.0)
    smooth = u**3 * (10 - 15 * u + 6 * u**2)
    early = np.clip(path.t_s / 0.5, 0.0, 1.0)
    for x_m, message in (
        (0.01 * (path.t_s > 0.3), "speed = .* m/s, allowed 0.0000..0.5000"),
        (0.002 * u, "jerk = .* m/s³, allowed"),
        (-0.6 * smooth, "x = -.* m, allowed 0.0000..1.0000"),
        (
            0.004 * early**3 * (10 - 15 * early + 6 * early**2),
            "leaves the present one .* too early",
        ),
    ):
        with pytest.raises(LimitError, match=message) as caught:
            guarded.revise(replace(path, x_m=path.x_m + x_m), start_s + 0.3)
        assert caught.value.remedy == "its path is followed as it was"
    guarded.revise(replace(path, x_m=path.x_m + 0.001 * smooth), start_s + 0.3)
    cell.clock.sleep_s(1.5)
    assert guarded.state().pose.x_m == pytest.approx(path.x_m[-1] + 0.001, abs=1e-4)


def test_force_outside_its_limits_is_refused(cell) -> None:
    gripper = GuardedGripper(cell.gripper, GripperLimits(5.0, 50.0))
    for force_n in (4.9, 50.1, float("nan")):
        with pytest.raises(LimitError, match=r"allowed 5.0000..50.0000 N; nothing was moved"):
            gripper.grip(force_n)
    assert cell.clock.now_s() == 0.0
    assert gripper.grip(20.0).holding


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        (CameraFaults(missing_frames=frozenset({3})), "frame 5 of 8 came where frame 4 was due"),
        (CameraFaults(missing_frames=frozenset({7})), "only 7 of 8 frames came"),
        (CameraFaults(frozen_from=4), "frame 5 of 8 repeats the picture before"),
        (CameraFaults(late_from=2, late_s=1.0), "frame 3 of 8 came 1.00. s late, allowed 0.500"),
    ],
)
def test_a_bad_recording_is_an_error(cell, faults, message) -> None:
    camera = GuardedCamera(cell.camera, cell.clock)
    cell.camera.faults = faults
    camera.start(8)
    with pytest.raises(CameraError, match=message):
        for _ in range(9):
            camera.read()


def test_uneven_times_are_an_error(cell) -> None:
    camera = GuardedCamera(cell.camera, cell.clock, CameraLimits(period_tolerance=0.5))
    camera.start(8)
    camera.read()
    cell.camera.faults = CameraFaults(stamp_error_s=0.003)
    with pytest.raises(CameraError, match=r"exposed 8.000 ms after the one before, expected 5.000"):
        camera.read()


def test_a_good_recording_passes_and_black_frames_are_left_to_vision(cell) -> None:
    camera = GuardedCamera(cell.camera, cell.clock)
    cell.camera.faults = CameraFaults(black_frames=frozenset(range(8)))
    for _ in range(2):
        camera.start(8)
        assert len(list(iter(camera.read, None))) == 8


def test_a_slow_reader_is_not_the_cameras_fault(cell) -> None:
    camera = GuardedCamera(cell.camera, cell.clock)
    camera.start(8)
    cell.clock.sleep_s(60.0)
    assert len(list(iter(camera.read, None))) == 8


def test_a_fast_part_with_few_points_is_judged_by_them() -> None:
    """Not by as many points as span 8 ms where the path has many."""
    rest = np.arange(0.0, 0.2, 0.001)
    coarse = 0.2 + 0.01 * np.arange(8)
    t_s = np.concatenate([rest, coarse])
    y_m = 0.3 + np.concatenate([0.0 * rest, 0.006 * (np.arange(8) % 2)])  # to and fro
    path = Trajectory(t_s, 0.3 + 0.0 * t_s, y_m, 0.0 * t_s)
    limits = replace(LIMITS, max_acceleration_m_per_s2=np.inf, max_jerk_m_per_s3=np.inf)
    with pytest.raises(LimitError, match=r"speed = 0.6000 m/s, allowed 0.0000..0.5000"):
        check_path(path, limits)


def test_a_change_is_compared_between_the_points_of_the_present_path_too(guarded, cell) -> None:
    here = guarded.state().pose
    still = Trajectory(
        np.array([0.0, 2.0]), *(np.full(2, v) for v in (here.x_m, here.y_m, here.angle_rad))
    )
    start_s = cell.clock.now_s() + 0.1
    guarded.follow(still, start_s)
    t_s = np.arange(0.0, 2.0005, 0.002)
    aside = 0.01 * 0.5 * (1.0 - np.cos(2.0 * np.pi * np.clip(t_s, 0.0, 1.5) / 1.5))
    x, y, angle = (np.interp(t_s, still.t_s, c) for c in (still.x_m, still.y_m, still.angle_rad))
    with pytest.raises(LimitError, match=r"leaves the present one .* too early: x_m"):
        guarded.revise(Trajectory(t_s, x + aside, y, angle), start_s + 1.5)


def test_a_stop_waits_for_no_log(guarded, cell) -> None:
    stopped: list[ArmMode] = []

    class SlowLog(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            stopped.append(cell.arm.state().mode)

    log, handler = logging.getLogger("drivers.guard"), SlowLog()
    log.addHandler(handler)
    try:
        guarded.stop("operator")
    finally:
        log.removeHandler(handler)
    assert stopped == [ArmMode.STOPPED]
