from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.interfaces import (
    ArmMode,
    ConnectError,
    DeviceLostError,
    StoppedError,
)
from drivers.sim.arm import ArmFaults, ArmTwinOptions, SimArm

STOPS = {
    "protective_stop_at_s": ArmMode.PROTECTIVE_STOP,
    "safeguard_stop_at_s": ArmMode.SAFEGUARD_STOP,
    "emergency_stop_at_s": ArmMode.EMERGENCY_STOP,
}


def test_measures_the_path_one_lag_late_within_the_noise(cell, line) -> None:
    path = line(dx_m=-0.05)
    cell.arm.follow(path)
    cell.clock.sleep_s(1.0)
    log = cell.arm.log(0.0, 1.0)
    assert len(log.t_s) == 501
    middle = (log.x_m > 0.46) & (log.x_m < 0.49)
    late = np.interp(log.t_s[middle] - 0.03, path.t_s, path.x_m)
    assert log.x_m[middle] == pytest.approx(late, abs=0.5e-3)  # a lag is not quite a delay
    still = log.x_m[log.t_s > 0.8]
    assert np.std(still) == pytest.approx(10e-6, rel=0.3)
    assert np.mean(still) == pytest.approx(0.45, abs=3e-6)


def test_the_same_moment_has_the_same_noise_and_another_seed_another(cell) -> None:
    cell.clock.sleep_s(3.0)
    whole = cell.arm.log(0.0, 3.0)
    part = cell.arm.log(2.0, 2.5)
    assert np.array_equal(part.x_m, whole.x_m[1000:1251])
    other = SimArm(cell.world, seed=99).log(0.0, 3.0)
    assert not np.array_equal(other.x_m, whole.x_m)


def test_true_lag_may_differ_from_the_one_admitted(cell, line) -> None:
    slow = SimArm(cell.world, ArmTwinOptions(lag_s=0.03, true_lag_s=0.06, noise_m=0.0))
    slow.connect()
    slow.follow(line(dx_m=-0.05))
    cell.clock.sleep_s(1.0)
    log = slow.log(0.0, 1.0)
    assert slow.lag_s == 0.03
    assert np.interp(0.2 + 0.06, log.t_s, log.x_m) == pytest.approx(0.475, abs=1e-3)


@pytest.mark.parametrize("fault", STOPS)
def test_a_controllers_stop_is_cleared_only_by_a_person(cell, line, fault) -> None:
    cell.arm.faults = ArmFaults(**{fault: 0.2})
    cell.arm.follow(line(dy_m=-0.05))
    cell.clock.sleep_s(0.3)
    state = cell.arm.state()
    assert state.mode is STOPS[fault]
    assert not state.moving and state.pose.y_m > 0.455
    for attempt in (cell.arm.reset, lambda: cell.arm.follow(line())):
        with pytest.raises(StoppedError, match=r"pendant|guard"):
            attempt()
    cell.arm.acknowledge()
    assert cell.arm.state().mode is ArmMode.STOPPED  # ours is still latched
    cell.arm.reset()
    assert cell.arm.state().mode is ArmMode.READY


@pytest.mark.parametrize(
    ("fault", "cause"), [("lost_at_s", "dropped"), ("frozen_at_s", "do not advance")]
)
def test_a_lost_arm_comes_to_rest_by_itself_and_can_be_reconnected(
    cell, line, fault, cause
) -> None:
    cell.arm.faults = ArmFaults(**{fault: 0.2})
    cell.arm.follow(line(dy_m=-0.05))
    cell.clock.sleep_s(0.5)
    with pytest.raises(DeviceLostError, match=cause):
        cell.arm.state()
    with pytest.raises(ConnectError):
        cell.arm.connect()
    assert cell.world.gripper_rest_from_s() < 0.2 + 0.06
    cell.arm.close()
    cell.arm.faults = ArmFaults()
    cell.arm.connect()
    assert cell.arm.state().mode is ArmMode.READY


def test_local_control_refuses_motion(cell, line) -> None:
    cell.arm.faults = replace(cell.arm.faults, local_control=True)
    with pytest.raises(StoppedError, match="remote control"):
        cell.arm.follow(line())


def test_a_slowed_motion_is_broken_off_and_stays_so(cell, line) -> None:
    cell.arm.follow(line(dy_m=-0.05))
    cell.clock.sleep_s(0.2)
    cell.arm.faults = ArmFaults(reduced_speed=True)
    assert cell.arm.state().mode is ArmMode.REDUCED_SPEED
    cell.clock.sleep_s(0.5)
    for attempt in (cell.arm.reset, lambda: cell.arm.follow(line())):
        with pytest.raises(StoppedError, match="speed slider"):
            attempt()
    assert cell.arm.state().pose.y_m > 0.455
    cell.arm.faults = ArmFaults()
    assert cell.arm.state().mode is ArmMode.STOPPED
    cell.arm.reset()
    assert cell.arm.state().mode is ArmMode.READY


def test_a_stop_may_be_planned_on_the_clock(cell, line) -> None:
    cell.clock.call_at(0.25, lambda: cell.arm.stop("operator"))
    cell.arm.follow(line(dy_m=-0.05))
    cell.clock.sleep_s(1.0)
    assert cell.world.gripper_rest_from_s() == pytest.approx(0.35, abs=1e-6)


def test_a_stop_that_waits_for_a_reset_is_not_cleared_by_it(cell) -> None:
    arm, world = cell.arm, cell.world
    arm.stop("operator")

    class ResetFirst:
        """The world's lock, got by somebody else's reset just before."""

        def __enter__(self) -> None:
            world.lock = lock
            arm.reset()

        def __exit__(self, *_: object) -> None:
            pass

    lock, world.lock = world.lock, ResetFirst()
    arm.stop("the watch")
    with pytest.raises(StoppedError, match="the watch"):
        arm._check_ready()
