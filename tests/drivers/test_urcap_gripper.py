"""The client of Robotiq's URCap against its emulated server, and another's emulated gripper."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.clock import RealClock
from drivers.emulators.robotiq import Jaws, RobotiqFaults
from drivers.emulators.urcap import EmulatedUrcap
from drivers.interfaces import ConnectError, DeviceError, DeviceLostError, DeviceTimeoutError
from drivers.urcap_gripper import UrcapGripper, UrcapGripperOptions

from .conftest import GRIPPER_REPLY_S

REFERENCE = Path(__file__).parents[3] / "shared" / "reference" / "robotiq_gripper.py"


def gripper_at(urcap: EmulatedUrcap, **options: Any) -> UrcapGripper:
    options = {"reply_s": 2.0 * GRIPPER_REPLY_S, "motion_s": 1.5} | options
    return UrcapGripper(UrcapGripperOptions(urcap.host, urcap.port, **options), RealClock())


@pytest.fixture
def urcap() -> Iterator[EmulatedUrcap]:
    with EmulatedUrcap(Jaws(object_count=200.0)) as it:
        yield it


@pytest.fixture
def gripper(urcap: EmulatedUrcap) -> Iterator[UrcapGripper]:
    it = gripper_at(urcap)
    it.connect()
    yield it
    it.close()


def test_force_becomes_counts(urcap: EmulatedUrcap, gripper: UrcapGripper) -> None:
    for force_n, count in ((20.0, 0), (235.0, 255), (127.5, 128)):
        gripper.grip(force_n)
        assert urcap.jaws.command[2] & 0xFF == pytest.approx(count, abs=1)
        gripper.release()


def test_it_is_activated_at_connect_after_a_fault_too_and_only_if_it_is_not_active(
    urcap: EmulatedUrcap, gripper: UrcapGripper
) -> None:
    gripper.grip(20.0)
    gripper.close()
    gripper.connect()
    assert gripper.state().holding, "an activation would have dropped it"
    urcap.jaws.write(0x3E8, [0])
    with pytest.raises(DeviceLostError, match=r"is no longer active; check the gripper's cable at"):
        gripper.state()
    gripper.connect()
    assert urcap.jaws.activation == 3 and not gripper.state().holding


@pytest.mark.parametrize("fault", ["silent", "garbage"])
def test_a_server_without_sense_is_a_lost_gripper_soon(
    urcap: EmulatedUrcap, gripper: UrcapGripper, fault: str
) -> None:
    setattr(urcap.jaws.faults, fault, True)
    began_s = time.monotonic()
    with pytest.raises(DeviceLostError, match="that Robotiq's URCap is installed"):
        gripper.state()
    assert time.monotonic() - began_s < 0.6
    assert UrcapGripperOptions("as shipped").reply_s < 2.0 * GRIPPER_REPLY_S, "and sooner still"
    with pytest.raises(DeviceLostError, match="not connected"):
        gripper.state()
    urcap.jaws.faults = RobotiqFaults()
    gripper.connect()
    assert not gripper.state().holding


def test_a_gripper_that_is_pulled_off_the_flange_is_lost(
    urcap: EmulatedUrcap, gripper: UrcapGripper
) -> None:
    gripper.grip(20.0)
    urcap.unplug()
    with pytest.raises(DeviceLostError, match=r"answers 'PRE \?'; check the gripper's cable at"):
        gripper.state()
    with pytest.raises(ConnectError, match=rf"no gripper on 127.0.0.1:{urcap.port}: answers"):
        gripper.connect()


def test_a_connection_that_ends_is_a_lost_gripper() -> None:
    with EmulatedUrcap(Jaws()) as urcap:
        gripper = gripper_at(urcap)
        gripper.connect()
    with pytest.raises(DeviceLostError):
        gripper.state()
    with pytest.raises(ConnectError, match="refused; check the gripper's cable"):
        gripper.connect()


def test_jams_and_faults_are_named(urcap: EmulatedUrcap, gripper: UrcapGripper) -> None:
    urcap.jaws.faults.jammed = True
    with pytest.raises(DeviceTimeoutError, match=r"motion not finished within 1.5 s; clear"):
        gripper.grip(20.0)
    urcap.jaws.faults.fault_code = 0x0E
    with pytest.raises(DeviceError, match="fault 0x0E: overcurrent"):
        gripper.grip(20.0)


class ReferenceJaws(Jaws):
    """Registers and motion of a gripper that others have emulated."""

    def __init__(self, other: Any) -> None:
        super().__init__()
        self._other = other

    def advance(self, passed_s: float) -> None:
        self._other.tick()

    def read(self, address: int) -> int:
        return int(self._other.regs(address))

    def write(self, address: int, values: list[int]) -> None:
        for i, value in enumerate(values):
            self._other.cmd[address - 0x3E8 + i] = value
        self._other.tick()


@pytest.mark.skipif(not REFERENCE.exists(), reason="needs the emulated gripper of ../shared")
def test_another_emulation_of_the_gripper_grips_and_releases() -> None:
    spec = importlib.util.spec_from_file_location("reference_gripper", REFERENCE)
    assert spec is not None and spec.loader is not None
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    other = reference.Robotiq2F85(object_at=180.0)
    with EmulatedUrcap(ReferenceJaws(other)) as urcap:
        gripper = gripper_at(urcap, motion_s=10.0)
        gripper.connect()
        gripped = gripper.grip(60.0)
        assert gripped.holding and gripped.opening_m == pytest.approx(0.085 * 50 / 230, abs=5e-4)
        assert other.cmd[2] & 0xFF == round(255 * 40 / 215)
        assert gripper.release().opening_m == pytest.approx(0.085, abs=5e-4)
        gripper.close()
