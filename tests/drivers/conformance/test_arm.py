"""What every arm keeps, guarded or not, simulated, emulated or real."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from drivers.interfaces import (
    Arm,
    ArmMode,
    ConnectError,
    DeviceLostError,
    LimitError,
    StoppedError,
    Trajectory,
)


@pytest.fixture
def bench(arm_bench):
    arm_bench.arm.connect()
    return arm_bench


def here(bench):
    return bench.arm.state().pose


def wait_for_rest(bench, patience_s: float = 5.0) -> None:
    until_s = bench.clock.now_s() + patience_s
    while bench.arm.state().moving:
        assert bench.clock.now_s() < until_s, "the arm did not come to rest"
        bench.clock.sleep_s(0.01)


def test_is_an_arm(arm_bench) -> None:
    assert isinstance(arm_bench.arm, Arm)
    assert arm_bench.arm.name
    assert arm_bench.arm.rate_hz > 0.0
    assert 0.0 <= arm_bench.arm.lag_s < 1.0


def test_is_ready_and_at_rest_once_connected(bench) -> None:
    state = bench.arm.state()
    assert state.mode is ArmMode.READY
    assert not state.moving
    assert abs(bench.clock.now_s() - state.t_s) < 0.1


def test_returns_at_once_and_then_follows(bench) -> None:
    start, began_s = here(bench), bench.clock.now_s()
    path = bench.make_path(dy_m=-0.05, start=start)
    bench.arm.follow(path)
    assert bench.clock.now_s() - began_s < path.t_s[-1]
    assert bench.arm.state().moving
    wait_for_rest(bench)
    assert here(bench).y_m == pytest.approx(start.y_m - 0.05, abs=2e-4)
    assert here(bench).x_m == pytest.approx(start.x_m, abs=2e-4)


def test_starts_at_the_moment_it_was_told(bench) -> None:
    start, told_s = here(bench), bench.clock.now_s()
    path = bench.make_path(dy_m=-0.05, start=start)
    start_s = told_s + 0.25
    bench.arm.follow(path, start_s)
    assert bench.clock.now_s() < start_s
    bench.clock.sleep_s(0.3)
    wait_for_rest(bench)
    log = bench.arm.log(told_s, bench.clock.now_s())
    gone_m = start.y_m - log.y_m
    half_way_s = float(np.interp(0.025, gone_m, log.t_s))
    assert half_way_s - start_s == pytest.approx(path.t_s[-1] / 2.0 + bench.arm.lag_s, abs=0.015)
    assert np.all(gone_m[log.t_s < start_s] < 2e-4)


def test_told_too_late_it_does_not_start_at_all(bench) -> None:
    start = here(bench)
    path = bench.make_path(dy_m=-0.05, start=start)
    with pytest.raises(LimitError, match=r"told .* ms after .*nothing was moved"):
        bench.arm.follow(path, bench.clock.now_s() - 0.01)
    assert not bench.arm.state().moving


def test_a_path_may_be_checked_from_anywhere_and_moves_nothing(bench) -> None:
    start = here(bench)
    elsewhere = replace(start, y_m=start.y_m - 0.05)
    bench.arm.check(bench.make_path(dy_m=0.05, start=elsewhere))
    bench.arm.stop("a check does not move, so a stop does not matter")
    bench.arm.check(bench.make_path(dx_m=-0.01, start=start))
    assert not bench.arm.state().moving
    assert here(bench).y_m == pytest.approx(start.y_m, abs=2e-4)


def test_logs_what_it_did_about_one_lag_late(bench) -> None:
    start = here(bench)
    path = bench.make_path(dy_m=-0.05, start=start)
    bench.arm.follow(path)
    began_s = bench.clock.now_s()
    wait_for_rest(bench)
    log = bench.arm.log(began_s, bench.clock.now_s())
    assert np.all(np.diff(log.t_s) > 0.0)
    assert began_s <= log.t_s[0] and log.t_s[-1] <= bench.clock.now_s()
    assert np.median(np.diff(log.t_s)) == pytest.approx(1.0 / bench.arm.rate_hz, rel=0.1)
    half = start.y_m - 0.025
    commanded_s = began_s + np.interp(-half, -path.y_m, path.t_s)
    measured_s = np.interp(-half, -log.y_m, log.t_s)
    assert measured_s - commanded_s == pytest.approx(bench.arm.lag_s, abs=0.02)


def test_stop_in_motion_stops_soon_and_stays(bench) -> None:
    start = here(bench)
    bench.arm.follow(bench.make_path(dy_m=-0.05, duration_s=0.6, start=start))
    bench.clock.sleep_s(0.3)
    bench.arm.stop("test")
    bench.clock.sleep_s(0.25)
    state = bench.arm.state()
    assert not state.moving and state.mode is ArmMode.STOPPED
    assert start.y_m - 0.048 < state.pose.y_m < start.y_m - 0.005
    bench.clock.sleep_s(0.5)
    assert here(bench).y_m == pytest.approx(state.pose.y_m, abs=2e-4)


def test_a_stop_from_another_thread_is_latched(bench) -> None:
    bench.arm.follow(bench.make_path(dy_m=-0.05, duration_s=0.6, start=here(bench)))
    bench.clock.sleep_s(0.2)
    thread = threading.Thread(target=bench.arm.stop, args=("another thread",))
    thread.start()
    thread.join(timeout=5.0)
    assert not thread.is_alive()
    wait_for_rest(bench)
    with pytest.raises(StoppedError, match="another thread"):
        bench.arm.follow(bench.make_path(start=here(bench)))


def test_a_stop_before_the_motion_is_not_lost(bench) -> None:
    bench.arm.stop("early")
    with pytest.raises(StoppedError, match="early"):
        bench.arm.follow(bench.make_path(start=here(bench)))


def test_a_stop_before_connecting_is_not_lost(arm_bench) -> None:
    arm_bench.arm.stop("very early")
    arm_bench.arm.connect()
    with pytest.raises(StoppedError, match="very early"):
        arm_bench.arm.follow(arm_bench.make_path(start=here(arm_bench)))


def test_works_again_after_reset(bench) -> None:
    bench.arm.stop("test")
    bench.arm.stop("twice")
    bench.arm.reset()
    start = here(bench)
    bench.arm.follow(bench.make_path(dx_m=-0.01, start=start))
    wait_for_rest(bench)
    assert here(bench).x_m == pytest.approx(start.x_m - 0.01, abs=2e-4)


def test_refuses_a_second_path_while_moving(bench) -> None:
    bench.arm.follow(bench.make_path(dy_m=-0.05, duration_s=0.6, start=here(bench)))
    with pytest.raises(LimitError, match="still moving"):
        bench.arm.follow(bench.make_path(dx_m=-0.05, start=here(bench)))


def sideways(path: Trajectory, from_s: float, dx_m: float, lasts_s: float = 0.3) -> Trajectory:
    """The same path until `from_s` after its beginning; then it leads `dx_m` aside as well."""
    t_s = np.arange(0.0, max(float(path.t_s[-1]), from_s + lasts_s) + 1e-9, 0.002)
    u = np.clip((t_s - from_s) / lasts_s, 0.0, 1.0)
    x_m, y_m, angle_rad = (np.interp(t_s, path.t_s, c) for c in list(vars(path).values())[1:])
    return Trajectory(t_s, x_m + dx_m * u**3 * (10.0 - 15.0 * u + 6.0 * u**2), y_m, angle_rad)


def under_way(bench) -> tuple[Trajectory, float]:
    """A path and when it was begun, 0.15 s ago."""
    path = bench.make_path(dy_m=-0.05, duration_s=0.6, start=here(bench))
    start_s = bench.clock.now_s() + 0.1
    bench.arm.follow(path, start_s)
    bench.clock.sleep_s(start_s + 0.15 - bench.clock.now_s())
    return path, start_s


def test_a_path_is_changed_while_it_is_followed(bench) -> None:
    start = here(bench)
    path, start_s = under_way(bench)
    after_s = bench.clock.now_s() - start_s + 0.1
    bench.arm.revise(sideways(path, after_s, -0.01), start_s + after_s)
    assert bench.arm.state().moving
    wait_for_rest(bench)
    assert here(bench).y_m == pytest.approx(start.y_m - 0.05, abs=2e-4)
    assert here(bench).x_m == pytest.approx(start.x_m - 0.01, abs=2e-4)
    log = bench.arm.log(start_s, bench.clock.now_s())
    assert np.all(np.abs(log.x_m - start.x_m)[log.t_s < start_s + after_s] < 2e-4)
    assert np.abs(np.diff(log.x_m)).max() < 0.001, "no jump from one pose to the next"


def test_a_change_that_comes_too_late_changes_nothing(bench) -> None:
    start = here(bench)
    path, start_s = under_way(bench)
    late_s = bench.clock.now_s() - start_s - 0.02
    with pytest.raises(LimitError, match=r"told .* ms after .*followed as it was"):
        bench.arm.revise(sideways(path, late_s, -0.01), start_s + late_s)
    wait_for_rest(bench)
    assert here(bench).y_m == pytest.approx(start.y_m - 0.05, abs=2e-4)
    assert here(bench).x_m == pytest.approx(start.x_m, abs=2e-4)


def test_what_rests_has_no_path_to_be_changed(bench) -> None:
    path = bench.make_path(dy_m=-0.05, start=here(bench))
    with pytest.raises(LimitError, match="follows no path"):
        bench.arm.revise(path, bench.clock.now_s() + 1.0)
    bench.arm.follow(path, bench.clock.now_s() + 0.1)
    bench.clock.sleep_s(0.1)
    wait_for_rest(bench)
    with pytest.raises(LimitError, match="follows no path"):
        bench.arm.revise(path, bench.clock.now_s() + 1.0)
    assert not bench.arm.state().moving


def test_a_stop_wins_over_a_change(bench) -> None:
    path, start_s = under_way(bench)
    bench.arm.stop("test")
    after_s = bench.clock.now_s() - start_s + 0.1
    with pytest.raises(StoppedError):
        bench.arm.revise(sideways(path, after_s, -0.01), start_s + after_s)
    wait_for_rest(bench, 0.5)
    x_m = here(bench).x_m
    bench.clock.sleep_s(0.3)
    assert here(bench).x_m == pytest.approx(x_m, abs=2e-4)


def test_a_changed_path_is_stopped_like_any_other(bench) -> None:
    path, start_s = under_way(bench)
    after_s = bench.clock.now_s() - start_s + 0.05
    bench.arm.revise(sideways(path, after_s, -0.01), start_s + after_s)
    bench.clock.sleep_s(0.1)
    bench.arm.stop("test")
    wait_for_rest(bench, 0.5)
    assert bench.arm.state().mode is ArmMode.STOPPED


def test_rests_within_the_time_that_steps_wait_and_then_takes_the_next_path(bench) -> None:
    """A step goes on one lag after the end of a path, while the arm may still settle."""
    from cell.run.waiting import rest_timeout_s  # the rest of the cell takes its time

    start = here(bench)
    path = bench.make_path(dy_m=-0.05, start=start)
    bench.arm.follow(path)
    bench.clock.sleep_s(float(path.t_s[-1]) + bench.arm.lag_s)
    until_s = bench.clock.now_s() + rest_timeout_s(bench.arm)
    while bench.arm.state().moving:
        assert bench.clock.now_s() < until_s, "a step would have given it up"
        bench.clock.sleep_s(0.002)
    assert here(bench).y_m == pytest.approx(start.y_m - 0.05, abs=2e-4)
    bench.arm.follow(bench.make_path(dy_m=0.05, start=here(bench)))
    wait_for_rest(bench)
    assert here(bench).y_m == pytest.approx(start.y_m, abs=3e-4)


def test_closing_stops_and_may_be_repeated(bench) -> None:
    bench.arm.follow(bench.make_path(dy_m=-0.05, duration_s=0.6, start=here(bench)))
    bench.clock.sleep_s(0.2)
    bench.arm.close()
    bench.arm.close()
    with pytest.raises(DeviceLostError):
        bench.arm.state()
    bench.clock.sleep_s(0.3)
    bench.arm.connect()
    assert not bench.arm.state().moving


def test_not_connected_is_an_error_but_stop_is_not(arm_bench) -> None:
    with pytest.raises(DeviceLostError):
        arm_bench.arm.state()
    for act in (arm_bench.arm.check, arm_bench.arm.follow):
        with pytest.raises(DeviceLostError):
            act(arm_bench.make_path())
    arm_bench.arm.stop("harmless")
    arm_bench.arm.close()


def test_an_arm_that_refuses_says_which_and_what_to_do(arm_bench) -> None:
    if arm_bench.refuse is None:
        pytest.skip("this bench cannot make its arm refuse")
    arm_bench.refuse()
    with pytest.raises(ConnectError) as error:
        arm_bench.arm.connect()
    assert error.value.device == arm_bench.arm.name
    assert error.value.remedy


def test_a_lost_arm_is_an_error_within_a_tenth_of_a_second(bench) -> None:
    if bench.lose is None:
        pytest.skip("this bench cannot lose its arm")
    bench.arm.follow(bench.make_path(dy_m=-0.05, duration_s=0.6, start=here(bench)))
    bench.clock.sleep_s(0.2)
    bench.lose()
    bench.clock.sleep_s(0.1)
    with pytest.raises(DeviceLostError) as error:
        bench.arm.state()
    assert error.value.device == bench.arm.name and error.value.remedy
    with pytest.raises(DeviceLostError):
        bench.arm.follow(bench.make_path())
    bench.arm.stop("lost")
    bench.arm.close()


def test_a_controllers_stop_needs_a_person(bench) -> None:
    if bench.controller_stop is None or bench.person_clears is None:
        pytest.skip("this bench cannot make its controller stop")
    bench.arm.follow(bench.make_path(dy_m=-0.05, duration_s=0.6, start=here(bench)))
    bench.clock.sleep_s(0.2)
    bench.controller_stop()
    bench.clock.sleep_s(0.2)
    assert bench.arm.state().mode is ArmMode.PROTECTIVE_STOP
    with pytest.raises(StoppedError) as error:
        bench.arm.reset()
    assert error.value.remedy
    stopped_at = here(bench)
    bench.person_clears()
    bench.clock.sleep_s(0.3)
    bench.arm.reset()
    assert bench.arm.state().mode is ArmMode.READY
    bench.clock.sleep_s(0.3)
    assert here(bench).y_m == pytest.approx(stopped_at.y_m, abs=2e-4)  # no stale command
    bench.arm.follow(bench.make_path(dy_m=0.01, start=here(bench)))
    wait_for_rest(bench)
    assert here(bench).y_m == pytest.approx(stopped_at.y_m + 0.01, abs=3e-4)
