"""Brings a failed cycle to rest, and turns its error into a fault."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

from cell.files.words import error_text
from cell.records.folder import RecordError
from cell.records.result import Fault, Outcome, Result
from cell.run.commands import InterruptedByCommandError
from cell.run.machine import MachineEvent
from cell.run.waiting import POLL_S, rest_timeout_s
from drivers.interfaces import (
    ArmMode,
    CameraError,
    ConnectError,
    DeviceError,
    DeviceLostError,
    Devices,
    DeviceTimeoutError,
)

#: Errors after which the devices are reconnected; after the others they are still connected.
UNREACHED = (ConnectError, DeviceLostError, DeviceTimeoutError, CameraError)

#: Errors that may end a cycle without a bug of the program.
EXPECTED = (DeviceError, InterruptedByCommandError, KeyboardInterrupt, RecordError)


def close(devices: Devices) -> None:
    """Disconnect all devices, even if one of them fails."""
    with ExitStack() as last_first:
        for device in (devices.gripper, devices.camera, devices.arm):
            last_first.callback(device.close)


def stop(devices: Devices, reason: str) -> None:
    """Stop the arm now; from any thread; latched until `reset`."""
    devices.arm.stop(reason)


def halt(devices: Devices, reason: str) -> ArmMode:
    """Stop the arm and the recording, and wait until the arm rests; the jaws stay as they are.

    returns  the arm's mode at rest; LOST if it does not answer: then its state is unknown
    """
    devices.arm.stop(reason)
    devices.camera.stop()
    end_s = devices.clock.now_s() + rest_timeout_s(devices.arm)
    try:
        while (state := devices.arm.state()).moving and devices.clock.now_s() < end_s:
            devices.clock.sleep_s(POLL_S)
    except DeviceError:
        return ArmMode.LOST
    return state.mode


def whereabouts_of_cable(devices: Devices) -> str:
    """Sentence that states whether a cable is in the jaws, by the gripper's report."""
    try:
        held = devices.gripper.state().holding
    except DeviceError:
        return "the gripper does not say whether a cable is in the jaws; look"
    return "a cable is in the jaws" if held else "no cable is in the jaws"


def unreached(error: BaseException) -> bool:
    """Whether an error, or the one that a command replaced, means an unreachable device."""
    return isinstance(error, UNREACHED) or isinstance(error.__context__, UNREACHED)


def fault_of(step: str, error: BaseException) -> tuple[Fault, MachineEvent]:
    """The fault that an error means in a step, and the event that it causes in the machine."""
    match error:
        case InterruptedByCommandError():
            event = error.event.value
            return Fault(step, error.reason or event, code=event), error.event
        case KeyboardInterrupt():
            cause = str(error) or "interrupted by a person"
            return Fault(step, cause, code=MachineEvent.STOP.value), MachineEvent.STOP
        case DeviceError():
            code = f"{error.device.replace(' ', '_')}.{error.code}"
            return Fault(
                step, error.cause, error.device, error.remedy, code=code
            ), MachineEvent.ABORT
        case RecordError():
            remedy = "make room there, or mend the disk"
            return Fault(step, str(error), remedy=remedy, code="record"), MachineEvent.ABORT
    return Fault(step, error_text(error), code="program"), MachineEvent.ABORT


def unrecorded(devices: Devices, step: str, result: Result, error: RecordError) -> Result:
    """Result of a cycle whose record cannot be closed: failed, if it has no fault already."""
    if result.fault is not None:
        return result
    fault, _ = fault_of(step, error)
    cable = whereabouts_of_cable(devices)
    return replace(result, outcome=Outcome.FAILED, fault=replace(fault, cable=cable))
