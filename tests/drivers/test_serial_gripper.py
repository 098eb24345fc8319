"""The real Modbus client against the emulated gripper, over a pseudo terminal."""

from __future__ import annotations

import os
import select
import socket
import threading
import time

import pytest

from drivers.clock import RealClock
from drivers.emulators.robotiq import EmulatedGripper
from drivers.interfaces import (
    ConnectError,
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
    LimitError,
)
from drivers.serial_gripper import SerialGripper, SerialGripperOptions

from .conftest import GRIPPER_REPLY_S


@pytest.fixture
def emulator():
    with EmulatedGripper() as it:
        yield it


@pytest.fixture
def gripper(emulator):
    options = SerialGripperOptions(emulator.port, reply_s=GRIPPER_REPLY_S, motion_s=1.5)
    it = SerialGripper(options, RealClock())
    it.connect()
    yield it
    it.close()


def test_force_becomes_counts(emulator, gripper) -> None:
    for force_n, count in ((20.0, 0), (235.0, 255), (127.5, 128)):
        gripper.grip(force_n)
        assert emulator.jaws.command[2] & 0xFF == pytest.approx(count, abs=1)
        gripper.release()
    for force_n in (19.9, 236.0):
        with pytest.raises(LimitError, match=r"allowed 20.0..235.0 N"):
            gripper.grip(force_n)


def test_opening_is_in_metres(emulator, gripper) -> None:
    assert gripper.grip(20.0).opening_m == pytest.approx(0.085 * 30 / 230, abs=0.0005)
    assert gripper.release().opening_m == pytest.approx(0.085, abs=0.0005)


@pytest.mark.parametrize("fault", ["silent", "bad_crc", "garbage"])
def test_a_line_without_sense_is_a_lost_gripper_soon(emulator, gripper, fault) -> None:
    setattr(emulator.jaws.faults, fault, True)
    began_s = time.monotonic()
    with pytest.raises(DeviceLostError, match=r"2 attempts.*check the gripper's cable"):
        gripper.state()
    assert time.monotonic() - began_s < 0.6
    assert SerialGripperOptions("as shipped").reply_s < GRIPPER_REPLY_S, "and sooner still"
    with pytest.raises(DeviceLostError, match="not connected"):
        gripper.state()
    setattr(emulator.jaws.faults, fault, False)
    gripper.connect()
    assert not gripper.state().holding


def test_one_bad_answer_is_asked_again(emulator, gripper, monkeypatch) -> None:
    original, bad = emulator._answer, iter([True])

    def flaky(frame: bytes) -> None:
        emulator.jaws.faults.bad_crc = next(bad, False)
        original(frame)

    monkeypatch.setattr(emulator, "_answer", flaky)
    assert not gripper.state().holding
    assert next(bad, None) is None  # the bad answer was really given


def test_an_unplugged_line_is_a_lost_gripper(emulator, gripper) -> None:
    emulator.unplug()
    with pytest.raises(DeviceLostError):
        gripper.state()
    with pytest.raises(ConnectError, match=r"no gripper on"):
        gripper.connect()


def test_jammed_jaws_time_out(emulator, gripper) -> None:
    emulator.jaws.faults.jammed = True
    with pytest.raises(DeviceTimeoutError, match=r"motion not finished within 1.5 s; clear"):
        gripper.grip(20.0)


def test_a_fault_of_the_gripper_is_named(emulator, gripper) -> None:
    emulator.jaws.faults.jammed = True
    emulator.jaws.faults.fault_code = 0x0E
    with pytest.raises(DeviceError, match=r"fault 0x0E: overcurrent"):
        gripper.grip(20.0)


@pytest.mark.parametrize("port", ["/dev/no-such-line", ""])
def test_a_line_that_is_not_there(port) -> None:
    with pytest.raises(ConnectError, match="no gripper on"):
        SerialGripper(SerialGripperOptions(port), RealClock()).connect()


@pytest.mark.parametrize("act", [lambda gripper: gripper.grip(20.0), SerialGripper.release])
def test_a_fault_that_only_an_activation_clears_is_no_motion_that_ended(
    emulator, gripper, act
) -> None:
    act(gripper)
    emulator.jaws.faults.fault_code = 0x0A  # and the other registers are as they were
    with pytest.raises(DeviceError, match=r"fault 0x0A: supply voltage too low"):
        act(gripper)


def test_hot_jaws_that_arrived_have_arrived(emulator, gripper) -> None:
    gripper.release()
    emulator.jaws.faults.fault_code = 0x08
    assert gripper.release().opening_m == pytest.approx(0.085, abs=0.0005)


def test_a_line_may_be_reached_through_a_network(emulator) -> None:
    """As that of a gripper on a tool flange, whose bytes the arm's controller passes on."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]

        def pass_on() -> None:
            client, _ = listening.accept()
            line = os.open(emulator.port, os.O_RDWR | os.O_NOCTTY)
            with client:
                while data := client.recv(256):
                    os.write(line, data)
                    while select.select([line], [], [], 0.03)[0]:
                        client.sendall(os.read(line, 256))
            os.close(line)

        passing = threading.Thread(target=pass_on, daemon=True)
        passing.start()
        url = f"socket://127.0.0.1:{port}"
        options = SerialGripperOptions(url, reply_s=10.0 * GRIPPER_REPLY_S, motion_s=10.0)
        gripper = SerialGripper(options, RealClock())
        gripper.connect()
        assert gripper.grip(20.0).holding
        assert not gripper.release().holding
        gripper.close()
        passing.join(10.0)
    with pytest.raises(ConnectError, match=f"no gripper on {url}"):
        gripper.connect()
