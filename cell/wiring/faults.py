"""Requests faults of emulated devices: at once, or some time after a cable is gripped."""

from __future__ import annotations

import difflib
import logging
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from cell.wiring.emulated import EmulatedCell
from drivers.emulators.camera import StreamFaults
from drivers.emulators.launch import EmulatorError
from drivers.emulators.robotiq import RobotiqFaults

#: Command that ends all faults; not a fault itself.
REPAIR = "repair"
#: Longest time after a grip, s.
_LONGEST_S = 3600.0
_PATTERN = re.compile(r"([a-z_.]+)(?:@([0-9]*\.?[0-9]+)\s*s?)?")
_LOG = logging.getLogger(__name__)

Act = Callable[[EmulatedCell], None]


@dataclass(frozen=True)
class RequestedFault:
    """A fault that a person has requested.

    after_s  time from the next grip of a cable; None = at once
    """

    name: str
    after_s: float | None = None

    def __str__(self) -> str:
        when = "" if self.after_s is None else f" {self.after_s:g} s after a cable is gripped"
        return f"{self.name}{when}"


def _arm(op: str, **arguments: Any) -> Act:
    def act(cell: EmulatedCell) -> None:
        cell.controller.request(op, **arguments)

    return act


def _camera(**faults: Any) -> Act:
    return lambda cell: setattr(cell.camera, "faults", StreamFaults(**faults))


def _gripper(**faults: Any) -> Act:
    return lambda cell: setattr(cell.gripper, "faults", RobotiqFaults(**faults))


#: Faults by name: what happens, and the action that causes it.
KINDS: Mapping[str, tuple[str, Act]] = {
    "arm.protective_stop": ("the controller stops the arm", _arm("protective_stop")),
    "arm.safeguard_stop": ("somebody opens the guard", _arm("safeguard_stop")),
    "arm.emergency_stop": ("somebody presses the button", _arm("emergency_stop")),
    "arm.slowed": ("the speed slider is set to 50 %", _arm("speed_fraction", value=0.5)),
    "arm.local": ("the pendant is switched to local control", _arm("local", on=True)),
    "arm.lost": ("its connections break off, once", _arm("drop")),
    "arm.frozen": ("the controller neither reads nor sends", _arm("freeze", seconds=1e6)),
    "arm.garbage": ("it sends random bytes, once", _arm("garbage")),
    "camera.lost": ("its connection breaks off, and none is accepted", _camera(refuses=True)),
    "camera.silent": ("no picture comes, the connection stays", _camera(silent=True)),
    "camera.frozen": ("the same picture comes again and again", _camera(frozen=True)),
    "camera.missing": ("one picture is missing, once", _camera(missing=1)),
    "camera.slow": ("pictures come at half the rate", _camera(slow=2.0)),
    "camera.garbage": ("random bytes come in place of pictures", _camera(garbage=True)),
    "gripper.lost": ("its cable is pulled", lambda cell: cell.gripper.unplug()),
    "gripper.silent": ("it does not answer", _gripper(silent=True)),
    "gripper.garbage": ("it answers random bytes", _gripper(garbage=True)),
    "gripper.checksums": ("its checksums are wrong", _gripper(bad_crc=True)),
    "gripper.jammed": ("the jaws do not move", _gripper(jammed=True)),
    "gripper.empty": (
        "the cable falls out of the jaws, or none is there",
        lambda cell: cell.gripper.lay_out(False),
    ),
}


def read_fault(text: str) -> RequestedFault:
    """`NAME` or `NAME@2s`.  Raises ValueError: no such fault, or no such time."""
    match = _PATTERN.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"{text!r}: must be a fault and a time, like camera.lost@2s")
    name, after = match.groups()
    if name not in KINDS:
        like = difflib.get_close_matches(name, KINDS, 1)
        hint = f"; is it {like[0]}?" if like else ""
        raise ValueError(f"{text!r}: there is no fault {name}{hint} There are {', '.join(KINDS)}")
    after_s = None if after is None else float(after)
    if after_s is not None and after_s > _LONGEST_S:
        raise ValueError(f"{text!r}: at most {_LONGEST_S:.0f} s after a cable is gripped")
    return RequestedFault(name, after_s)


class DeviceFaults:
    """Causes faults of emulated devices, and ends them.

    say  called with a message at every event, from any thread
    """

    def __init__(self, cell: EmulatedCell, say: Callable[[str], None]) -> None:
        self._cell = cell
        self._say = say
        self._lock = threading.Lock()
        self._awaited: list[RequestedFault] = []
        self._timers: list[threading.Timer] = []
        cell.on_grip = self._gripped

    def give(self, fault: RequestedFault) -> None:
        """Cause a fault at once, or when it is due."""
        if fault.after_s is None:
            self._cause(fault)
            return
        with self._lock:
            self._awaited.append(fault)
        self._say(f"{fault}: waits for a cable")

    def repair(self) -> None:
        """End all faults, and cancel those that are not due yet."""
        with self._lock:
            for timer in self._timers:
                timer.cancel()
            self._awaited, self._timers = [], []
        try:
            self._mend()
        except (EmulatorError, OSError) as error:  # a dead emulator, which is reported elsewhere
            self._say(f"{REPAIR}: {error}")
            return
        _LOG.info("faults repaired")
        self._say("all faults are repaired")

    def _mend(self) -> None:
        arm, camera, gripper = self._cell.controller, self._cell.camera, self._cell.gripper
        arm.request("freeze", seconds=0.0)
        arm.request("local", on=False)
        arm.request("speed_fraction", value=1.0)
        arm.request("clear")
        camera.faults, gripper.faults = StreamFaults(), RobotiqFaults()
        gripper.plug()
        gripper.lay_out(True)

    def _gripped(self) -> None:
        with self._lock:
            due, self._awaited = self._awaited, []
            new = [threading.Timer(f.after_s or 0.0, self._cause, (f,)) for f in due]
            self._timers += new
        for timer in new:
            timer.daemon = True
            timer.start()

    def _cause(self, fault: RequestedFault) -> None:
        what, cause = KINDS[fault.name]
        try:
            cause(self._cell)
        except Exception as error:  # a timer's thread has no other report
            self._say(f"{fault.name}: cannot be given: {error}")
            return
        _LOG.info("fault given: %s", fault.name)
        self._say(f"{fault.name}: {what}")
