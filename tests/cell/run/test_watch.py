"""Somebody looks at the devices all the time, and stops the arm before anybody else looks."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from cell.run.commands import Commands
from cell.run.watch import SafetyWatch
from drivers.interfaces import ArmMode, DeviceError, DeviceLostError, GripError, StoppedError
from tests.waiting import wait_until


class Device:
    raises: Exception | None = None

    def check(self) -> None:
        if self.raises is not None:
            raise self.raises


class Arm(Device):
    name = "arm"

    def __init__(self) -> None:
        self.mode, self.lost, self.stopped = ArmMode.READY, False, []

    def state(self) -> SimpleNamespace:
        super().check()
        if self.lost:
            raise DeviceLostError("arm", "silent", "look")
        return SimpleNamespace(mode=self.mode)

    def stop(self, reason: str) -> None:
        self.stopped.append(reason)


class Camera(Device):
    name = "camera"

    def __init__(self) -> None:
        self.lost = False

    def check(self) -> None:
        super().check()
        if self.lost:
            raise DeviceLostError("camera", "dark", "look")


class Gripper(Device):
    name = "gripper"

    def __init__(self) -> None:
        self.holding, self.lost = True, False

    def state(self) -> SimpleNamespace:
        super().check()
        if self.lost:
            raise DeviceLostError("gripper", "unplugged", "plug it in")
        return SimpleNamespace(holding=self.holding)


@pytest.fixture
def it():
    arm, gripper, camera, commands = Arm(), Gripper(), Camera(), Commands()
    bench = SimpleNamespace(
        devices=SimpleNamespace(arm=arm, gripper=gripper, camera=camera), commands=commands
    )
    it = SimpleNamespace(
        arm=arm, gripper=gripper, camera=camera, commands=commands, watch=SafetyWatch(bench)
    )
    it.watch.begin()
    it.watch.holding = True
    yield it
    it.watch.end()


def failure(it: SimpleNamespace) -> DeviceError:
    wait_until(lambda: it.arm.stopped, 2.0, lambda: "the arm was not stopped")
    with pytest.raises(DeviceError) as caught:
        it.commands.check()
    return caught.value


def test_while_all_is_well_nothing_is_said(it) -> None:
    time.sleep(0.1)
    it.commands.check()
    assert not it.arm.stopped


def test_an_arm_that_is_stopped_or_lost_ends_the_cycle(it) -> None:
    it.arm.mode = ArmMode.PROTECTIVE_STOP
    error = failure(it)
    assert isinstance(error, StoppedError) and error.cause == "is in protective stop"
    assert it.arm.stopped == [error.cause]


def test_a_lost_gripper_stops_the_arm(it) -> None:
    it.gripper.lost = True
    assert (failure(it).device, it.arm.stopped) == ("gripper", ["unplugged"])


def test_a_lost_camera_stops_the_arm(it) -> None:
    it.camera.lost = True
    assert (failure(it).device, it.arm.stopped) == ("camera", ["dark"])


def test_a_lost_cable_is_missed_only_where_one_has_to_be(it) -> None:
    it.watch.holding = False
    it.gripper.holding = False
    time.sleep(0.1)
    it.commands.check()
    it.watch.holding = True
    assert isinstance(failure(it), GripError)


def test_the_first_cause_counts_and_is_forgotten_when_acknowledged(it) -> None:
    it.arm.lost = True
    first = failure(it)
    it.gripper.lost = True
    time.sleep(0.1)
    with pytest.raises(DeviceLostError, match="silent"):
        it.commands.check()
    assert first.device == "arm"
    it.commands.clear()
    it.commands.check()


def test_what_follows_a_stop_is_not_a_fault(it) -> None:
    it.watch.cease()
    time.sleep(0.05)
    it.arm.mode = ArmMode.STOPPED
    time.sleep(0.1)
    it.commands.check()


@pytest.mark.parametrize("device", ["arm", "camera", "gripper"])
def test_a_watch_that_dies_stops_the_arm(it, device: str) -> None:
    """A driver that raises what no driver should: nobody watches the device from then on."""
    getattr(it, device).raises = ValueError("bad frame")
    error = failure(it)
    assert isinstance(error, DeviceLostError) and error.device == device
    assert error.cause == "the watch over it has ended: ValueError: bad frame"
    assert it.arm.stopped == [error.cause]
