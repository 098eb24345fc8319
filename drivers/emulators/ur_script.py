"""The command loop of the program that ur-rtde uploads, re-implemented on its registers.

The client writes a command number and its arguments into input registers; the program answers 1
(ready) or 2 (done) in an output register.  A servo command acts in every cycle in which its number
stands there; the others once, until the client has put the number back to 0.  Only the commands of
the driver are emulated; any other is a runtime error.

source  rtde_control.script of ur-rtde 1.6.5; URScript itself is not interpreted
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from drivers.emulators.ur_arm import Decelerate, Joints, Servo
from drivers.interfaces import FloatArray
from drivers.rtde_wire import REGISTERS
from drivers.ur_kinematics import OutOfReachError
from drivers.ur_pose import matrix_of

READY, DONE = 1, 2


class ScriptCommand(IntEnum):
    """Numbers of the emulated commands."""

    NONE = 0
    SERVO_STOP = 16
    SERVO_LINE = 24
    SET_TCP = 29
    SET_WATCHDOG = 35
    STOP_SCRIPT = 255


class ScriptError(Exception):
    """The program ended with a runtime error, as it does on a real controller."""


@dataclass
class Registers:
    """General purpose registers of the controller."""

    int_in: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    double_in: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    int_out: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    double_out: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)


class ControlScript:
    """One run of the program.

    watch   called with a register and the lowest rate at which it must be written, Hz
    note    called with an event
    offset  first register used: 0, or 24 for the upper range
    """

    def __init__(
        self,
        registers: Registers,
        joints: Joints,
        watch: Callable[[int, float], None],
        note: Callable[[str], None],
        offset: int,
    ) -> None:
        self._registers = registers
        self._joints = joints
        self._watch = watch
        self._note = note
        self._offset = offset
        self._executing = False
        self._servo: Servo | None = None
        self._stop: Decelerate | None = None  # its command is done when the arm rests
        self._answer(READY)

    def cycle(self, step_s: float) -> bool:
        """One controller cycle; False when the program has ended by command.

        raises  ScriptError: an unreachable target, or a command that is not emulated
        """
        if self._stop is not None:
            if self._stop.step(self._joints, step_s):
                return True
            self._stop = None
            self._answer(DONE)
        command = self._registers.int_in[self._offset]
        if command == ScriptCommand.STOP_SCRIPT:
            return False
        self._process(command)
        if self._servo is not None:
            self._servo.step(self._joints, step_s)
        elif self._stop is None:
            self._joints.rest()
        return True

    def _process(self, command: int) -> None:
        if command == ScriptCommand.NONE:
            self._executing = False
            self._answer(READY)
        elif command == ScriptCommand.SERVO_LINE:
            self._servo = Servo(self._target_rad(), self._double(9))
            self._answer(READY)
        elif not self._executing:
            self._executing = True
            self._run(command)
            if self._stop is None:
                self._answer(DONE)

    def _run(self, command: int) -> None:
        match command:
            case ScriptCommand.SERVO_STOP:
                self._note("servo stop")
                self._servo = None
                self._stop = Decelerate(max(self._double(0), 1e-3), in_joints=False)
            case ScriptCommand.SET_TCP:
                self._joints.X_FT = matrix_of(self._vector())
            case ScriptCommand.SET_WATCHDOG:
                self._watch(self._offset, self._double(0))
            case _:
                raise ScriptError(f"command {command} is not emulated")

    def _target_rad(self) -> FloatArray:
        try:
            return self._joints.joints_at(matrix_of(self._vector()))
        except OutOfReachError as error:
            raise ScriptError(f"inverse kinematics: {error}") from error

    def _double(self, index: int) -> float:
        return self._registers.double_in[self._offset + index]

    def _vector(self) -> FloatArray:
        return np.array(self._registers.double_in[self._offset : self._offset + 6])

    def _answer(self, value: int) -> None:
        self._registers.int_out[self._offset] = value
