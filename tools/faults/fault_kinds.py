"""The faults that the trials inject, and how a person ends them."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from cell.wiring.emulated import EmulatedCell
from drivers.emulators.camera import StreamFaults
from drivers.emulators.robotiq import RobotiqFaults

OFF_S = 0.5  # a power cycle


@dataclass(frozen=True)
class Victim:
    """Objects that faults act on: the emulators, and the process of the arm's client."""

    emulated: EmulatedCell
    child: Callable[[], int]


Act = Callable[[Victim], object]


@dataclass(frozen=True)
class Kind:
    """A fault: its cause, and its repair by a person."""

    device: str
    fault: str
    cause: Act
    repair: Act
    at_connect: bool = False
    drops_cable: bool = False


@dataclass
class FaultTrial:
    """A fault in a step, and the cell's reaction.

    reaction_s  from the fault, or from the beginning of the step that needs the device, until the
                arm was commanded to stop; None = there was nothing to stop
    moved_on_s  from the same moment until the emulated arm stood still
    wrong       one sentence for each violation; empty = passed
    """

    kind: Kind
    step: str
    given_s: float | None = None
    held_before: bool = False
    noticed: str = ""
    reaction_s: float | None = None
    moved_on_s: float = 0.0
    attempts: int = 0
    wrong: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"{self.kind.device}: {self.kind.fault} in {self.step}"

    def begin(self) -> None:
        self.given_s, self.reaction_s, self.wrong, self.noticed = None, None, [], ""
        self.moved_on_s, self.attempts = 0.0, self.attempts + 1


def _camera(**faults: Any) -> Act:
    return lambda victim: setattr(victim.emulated.camera, "faults", StreamFaults(**faults))


def _gripper(**faults: Any) -> Act:
    return lambda victim: setattr(victim.emulated.gripper, "faults", RobotiqFaults(**faults))


def _unplug(victim: Victim) -> None:
    victim.emulated.gripper.unplug()


def _plug(victim: Victim) -> None:
    victim.emulated.gripper.plug()


def _cable(there: bool) -> Act:
    return lambda victim: victim.emulated.gripper.lay_out(there)


def _arm(op: str, **arguments: Any) -> Act:
    return lambda victim: victim.emulated.controller.request(op, **arguments)


def _kill_child(victim: Victim) -> None:
    os.kill(victim.child(), signal.SIGKILL)


def _off_and_on(off: Act, on: Act) -> Act:
    def act(victim: Victim) -> None:
        off(victim)
        threading.Timer(OFF_S, on, (victim,)).start()

    return act


def _nothing(victim: Victim) -> None:
    """No repair: the cell connects again."""


def _later(victim: Victim) -> None:
    """No repair: the device returns by itself."""
    time.sleep(OFF_S + 0.2)


KINDS = (
    Kind("arm", "refuses to connect", _arm("refuse", on=True), _arm("refuse", on=False), True),
    Kind("arm", "connection drops", _arm("drop"), _nothing),
    Kind("arm", "freezes", _arm("freeze", seconds=1e6), _arm("freeze", seconds=0.0), True),
    Kind("arm", "answers garbage", _arm("garbage"), _nothing),
    Kind("arm", "protective stop", _arm("protective_stop"), _arm("clear"), True),
    Kind("arm", "emergency stop", _arm("emergency_stop"), _arm("clear"), True),
    Kind("arm", "child killed", _kill_child, _nothing),
    Kind("arm", "power cycle", _arm("power_cycle", seconds=OFF_S), _later),
    Kind("camera", "refuses to connect", _camera(refuses=True), _camera(), True),
    Kind("camera", "connection drops", _camera(refuses=True), _camera()),
    Kind("camera", "falls silent", _camera(silent=True), _camera(), True),
    Kind("camera", "freezes", _camera(frozen=True), _camera()),
    Kind("camera", "answers garbage", _camera(garbage=True), _camera(), True),
    Kind("camera", "power cycle", _off_and_on(_camera(refuses=True), _camera()), _later),
    Kind("gripper", "refuses to connect", _unplug, _plug, True),
    Kind("gripper", "unplugged", _unplug, _plug),
    Kind("gripper", "falls silent", _gripper(silent=True), _gripper(), True),
    Kind("gripper", "answers garbage", _gripper(garbage=True), _gripper(), True),
    Kind("gripper", "bad checksums", _gripper(bad_crc=True), _gripper(), True),
    Kind("gripper", "power cycle", _off_and_on(_unplug, _plug), _later),
    Kind("gripper", "cable lost", _cable(False), _cable(True), drops_cable=True),
)
