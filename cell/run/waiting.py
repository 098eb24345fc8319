"""Waiting until a moment or until the arm rests, and looking whether devices are as needed."""

from __future__ import annotations

from cell.run.station import Station
from drivers.interfaces import ArmMode, DeviceTimeoutError, GripError, StoppedError

#: How long a wait is between two looks at the commands, s.
POLL_S = 0.01
#: Longest time that an arm needs to rest after the end of its path, beyond its lag, s.
REST_TIMEOUT_S = 1.0
#: The arm is told so long before it is to start, because it first checks where a path leads, s.
AHEAD_S = 0.1


def wait_until(station: Station, t_s: float) -> None:
    """Let time pass.  Raises InterruptedByCommandError."""
    station.commands.check()
    clock = station.devices.clock
    while (left_s := t_s - clock.now_s()) > 0.0:
        clock.sleep_s(min(left_s, POLL_S))
        station.commands.check()


def await_rest(station: Station) -> None:
    """Wait for an arm whose path has ended.  Raises DeviceTimeoutError; StoppedError."""
    arm, clock = station.devices.arm, station.devices.clock
    end_s = clock.now_s() + REST_TIMEOUT_S
    while arm.state().moving:
        if clock.now_s() > end_s:
            raise DeviceTimeoutError(
                arm.name,
                f"still moves {REST_TIMEOUT_S:g} s after its path has ended",
                "check the arm's lag and speed slider",
            )
        wait_until(station, clock.now_s() + POLL_S)
    check_arm(station)


def check_arm(station: Station) -> None:
    """Whether the arm is ready.  Raises StoppedError."""
    arm = station.devices.arm
    mode = arm.state().mode
    if mode is not ArmMode.READY:
        raise StoppedError(arm.name, f"is in {mode.value.replace('_', ' ')}", mode.remedy)


def check_grip(station: Station) -> None:
    """Whether the cable is held.  Raises GripError."""
    gripper = station.devices.gripper
    if not gripper.state().holding:
        raise GripError(gripper.name, "lost the cable", "check force and jaws")
