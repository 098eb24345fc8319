"""Waits for a moment, for the arm's rest or for a computation, while checking the devices."""

from __future__ import annotations

from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

from cell.computer.second_process import SecondProcess
from cell.run.commands import Commands
from cell.run.station import Station
from drivers.interfaces import Arm, ArmMode, DeviceTimeoutError, GripError, StoppedError
from drivers.servo import SETTLING_LAGS

#: Interval between two checks of the commands during a wait, s.
POLL_S = 0.01
#: Longest time that an arm needs to rest after the end of its path, beyond that of its servo, s.
REST_TIMEOUT_S = 1.0
#: Time from a command to the start of its path, s: the arm first checks the path.
AHEAD_S = 0.1


def wait_until(station: Station, t_s: float) -> None:
    """Wait until a time on the cell's clock.  Raises InterruptedByCommandError."""
    station.commands.check()
    clock = station.devices.clock
    while (remaining_s := t_s - clock.now_s()) > 0.0:
        clock.sleep_s(min(remaining_s, POLL_S))
        station.commands.check()


def rest_timeout_s(arm: Arm) -> float:
    """Longest time until an arm rests after the end of its path, s."""
    return REST_TIMEOUT_S + SETTLING_LAGS * arm.lag_s


def await_rest(station: Station) -> None:
    """Wait until the arm rests and accepts a new path.

    raises  DeviceTimeoutError; StoppedError
    """
    arm, clock = station.devices.arm, station.devices.clock
    begun_s = clock.now_s()
    while arm.state().moving:
        waited_s = clock.now_s() - begun_s
        if waited_s > rest_timeout_s(arm):
            raise DeviceTimeoutError(
                arm.name,
                f"still moves {waited_s:.1f} s after its path has ended",
                "check the arm's lag and speed slider",
            )
        wait_until(station, clock.now_s() + POLL_S)
    check_arm(station)


def check_arm(station: Station) -> None:
    """Check that the arm is ready.  Raises StoppedError."""
    arm = station.devices.arm
    mode = arm.state().mode
    if mode is not ArmMode.READY:
        raise StoppedError(arm.name, f"is in {mode.value.replace('_', ' ')}", mode.remedy, mode)


def check_grip(station: Station) -> None:
    """Check that the cable is held.  Raises GripError."""
    gripper = station.devices.gripper
    if not gripper.state().holding:
        raise GripError(gripper.name, "lost the cable", "check force and jaws")


Value = TypeVar("Value")

#: A computation that takes longer has failed, s.
LONGEST_S = 5.0


def result_of(job: Future[Value], commands: Commands) -> Value | None:
    """Result of a job; None if its process was killed or does not finish.

    raises  InterruptedByCommandError
    """
    for _ in range(round(LONGEST_S / POLL_S)):
        commands.check()
        try:
            return job.result(POLL_S)
        except TimeoutError:
            if job.done():  # it is the job's own
                raise
        except BrokenExecutor:
            return None
    return None


def hurried(computer: Executor) -> AbstractContextManager[None]:
    """Give the second process normal priority while the gripper or a frame waits for it."""
    return computer.hurried() if isinstance(computer, SecondProcess) else nullcontext()
