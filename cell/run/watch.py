"""Watches all devices while the steps of a cycle run, and stops the arm at a fault.

A step checks a device when it needs it; a fault in between would be noticed too late.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial

from cell.run.station import Station
from cell.run.waiting import check_arm, check_grip
from drivers.interfaces import DeviceError, DeviceLostError, GripError
from drivers.threads import GuardedThread, error_text

#: Time between two checks, s.  A fault must be noticed within 100 ms, including two answers of the
#: gripper's driver, 35 ms each.
ARM_EVERY_S, CAMERA_EVERY_S, GRIPPER_EVERY_S = 0.01, 0.015, 0.015
#: A check later than this means that the computer was busy, s.
OVERSLEPT_S = 0.02
_REMEDY = "look at the device, then acknowledge; if it comes again, report it with `cell bundle`"


class SafetyWatch:
    """Watchdog thread, active from `begin` on; only devices that run in real time are watched.

    holding  whether a cable has to be between the jaws
    """

    def __init__(self, station: Station) -> None:
        self.holding = False
        self._station = station
        self._over = threading.Event()
        devices = station.devices
        arm, camera, gripper = devices.arm, devices.camera, devices.gripper
        checks = (
            (arm.name, partial(check_arm, station), ARM_EVERY_S),
            (camera.name, camera.check, CAMERA_EVERY_S),
            (gripper.name, self._check_gripper, GRIPPER_EVERY_S),
        )
        self._threads = [
            GuardedThread(
                f"watch {name}", partial(self._run, check, every_s), partial(self._unwatched, name)
            )
            for name, check, every_s in checks
        ]

    def begin(self) -> None:
        """Watch from now on."""
        for thread in self._threads:
            thread.start()

    def cease(self) -> None:
        """Stop watching: what follows is known, or intended."""
        self._over.set()

    def end(self) -> None:
        """Stop watching, and wait until all threads have ended."""
        self.cease()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def _run(self, check: Callable[[], None], every_s: float) -> None:
        overslept = False
        due_s = time.monotonic() + every_s
        while not self._over.wait(every_s):
            late_s = time.monotonic() - due_s
            # after a stall of this process devices seem silent: they get the time of one more check
            overslept = not overslept and late_s > OVERSLEPT_S
            try:
                if not overslept:
                    check()
            except DeviceError as error:
                self._fail(error)
                return
            due_s = time.monotonic() + every_s

    def _unwatched(self, device: str, error: BaseException) -> None:
        """Fail: the device is watched no more, and its faults would not be noticed."""
        self._fail(
            DeviceLostError(device, f"the watch over it has ended: {error_text(error)}", _REMEDY)
        )

    def _fail(self, error: DeviceError) -> None:
        if not self._over.is_set():
            self._station.commands.fail(error)
            self._station.devices.arm.stop(error.cause)

    def _check_gripper(self) -> None:
        if self.holding:
            try:
                check_grip(self._station)
            except GripError:
                if self.holding:  # it was not let go on purpose meanwhile
                    raise
