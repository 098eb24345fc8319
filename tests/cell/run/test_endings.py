"""Every fault has a code, the same for all causes of a kind: statistics count it."""

from __future__ import annotations

import pytest

from cell.records.folder import RecordError
from cell.run.commands import InterruptedByCommandError
from cell.run.endings import fault_of
from cell.run.machine import MachineEvent
from drivers.interfaces import (
    ArmMode,
    CameraError,
    ConnectError,
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
    GripError,
    LimitError,
    StoppedError,
)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (LimitError("arm", "too far"), "arm.limit"),
        (ConnectError("UR arm", "no answer"), "UR_arm.connect"),
        (DeviceLostError("camera", "silent"), "camera.lost"),
        (DeviceTimeoutError("gripper", "blocked"), "gripper.timeout"),
        (StoppedError("arm", "protective stop"), "arm.stopped"),
        (StoppedError("arm", "found", mode=ArmMode.PROTECTIVE_STOP), "arm.protective_stop"),
        (StoppedError("arm", "slider", mode=ArmMode.REDUCED_SPEED), "arm.reduced_speed"),
        (GripError("gripper", "no cable"), "gripper.grip"),
        (CameraError("camera", "frozen"), "camera.frames"),
        (DeviceError("computer", "too slow"), "computer.device"),
        (InterruptedByCommandError(MachineEvent.ABORT, "a person"), "abort"),
        (KeyboardInterrupt(), "stop"),
        (RecordError("disk full"), "record"),
        (ZeroDivisionError("a mistake"), "program"),
    ],
)
def test_the_code_names_device_and_kind(error: BaseException, code: str) -> None:
    fault, _ = fault_of("lower", error)
    assert fault.code == code
    assert fault.step == "lower"
