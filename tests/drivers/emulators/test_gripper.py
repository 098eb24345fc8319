"""The gripper's process: a line with a name, a cable in the jaws, and a plug to pull."""

from __future__ import annotations

import os
import signal

import pytest

from drivers.clock import RealClock
from drivers.emulators.gripper import GripperProcess
from drivers.emulators.launch import EmulatorError
from drivers.emulators.robotiq import RobotiqFaults
from drivers.interfaces import DeviceLostError, GripError
from drivers.serial_gripper import SerialGripper, SerialGripperOptions
from tests.waiting import wait_until

from ..conftest import GRIPPER_REPLY_S


@pytest.fixture
def emulator(tmp_path):
    with GripperProcess(tmp_path / "lines" / "gripper") as it:
        yield it


@pytest.fixture
def gripper(emulator):
    it = SerialGripper(SerialGripperOptions(emulator.port, reply_s=GRIPPER_REPLY_S), RealClock())
    it.connect()
    yield it
    it.close()


def test_it_is_reached_by_the_name_of_its_line(emulator, gripper, tmp_path) -> None:
    assert emulator.port == str(tmp_path / "lines" / "gripper")
    assert not emulator.observe().held
    assert gripper.grip(20.0).holding and emulator.observe().held
    assert not gripper.release().holding and not emulator.observe().held


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_happens_at_the_terminal_is_its_parents_affair(emulator, gripper, number) -> None:
    os.kill(emulator.pid, number)
    assert gripper.grip(20.0).holding
    assert emulator.alive and emulator.observe().held


def test_a_cable_that_is_taken_away_is_missed(emulator, gripper) -> None:
    gripper.grip(20.0)
    emulator.lay_out(False)
    wait_until(lambda: not gripper.state().holding)
    gripper.release()
    with pytest.raises(GripError, match="nothing between the jaws"):
        gripper.grip(20.0)


def test_after_its_power_was_off_the_jaws_still_hold_and_it_is_reached_again(
    emulator, gripper
) -> None:
    gripper.grip(20.0)
    emulator.unplug()
    with pytest.raises(DeviceLostError):
        gripper.state()
    emulator.plug()
    seen = emulator.observe()
    assert seen.held and not seen.active
    gripper.connect()
    assert emulator.observe().active


def test_faults_reach_it(emulator, gripper) -> None:
    emulator.faults = RobotiqFaults(bad_crc=True)
    with pytest.raises(DeviceLostError, match="attempts"):
        gripper.state()


def test_a_file_that_is_no_line_is_left_alone(tmp_path) -> None:
    (tmp_path / "precious").write_text("data")
    with pytest.raises(EmulatorError, match="precious exists and is no link"):
        GripperProcess(tmp_path / "precious").__enter__()
    assert (tmp_path / "precious").read_text() == "data"


def test_killed_it_is_gone(emulator) -> None:
    os.kill(emulator.pid, signal.SIGKILL)
    with pytest.raises(EmulatorError, match="gripper is gone"):
        for _ in range(1000):
            emulator.observe()
