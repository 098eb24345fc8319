"""The command loop of the program that ur-rtde uploads, re-implemented on its registers.

The client writes a command number and its arguments into input registers; the program answers 1
(ready) or 2 (done) in an output register.  Real-time commands act in every cycle in which their
number stands there; the others once, until the client has put the number back to 0.

source  rtde_control.script of ur-rtde 1.6.5; URScript itself is not interpreted
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from drivers.emulators.ur_arm import (
    Decelerate,
    JointMotion,
    Joints,
    MoveJoints,
    MoveLine,
    Servo,
    Speed,
)
from drivers.interfaces import FloatArray
from drivers.rtde_wire import REGISTERS
from drivers.ur_kinematics import OutOfReachError
from drivers.ur_pose import matrix_of, pose_of

READY, DONE = 1, 2

_REAL_TIME = frozenset({9, 10, 11, 24})
_STOP_SCRIPT = 255


class ScriptError(Exception):
    """The program ended with a runtime error, as it does on a real controller."""


@dataclass
class Registers:
    """General purpose registers of the controller."""

    int_in: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    double_in: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    int_out: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    double_out: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)


@dataclass
class Effects:
    """Callbacks for effects of the program other than motions and register writes."""

    protective_stop: Callable[[str], None]
    watch: Callable[[int, float], None]  # register, lowest frequency in Hz
    set_payload: Callable[[float], None]
    note: Callable[[str], None]


class ControlScript:
    """One run of the program.

    offset  first register used: 0, or 24 for the upper range
    """

    def __init__(self, registers: Registers, joints: Joints, effects: Effects, offset: int) -> None:
        self._registers = registers
        self._joints = joints
        self._effects = effects
        self._offset = offset
        self._executing = False
        self._blocking: JointMotion | None = None  # of a command that is not done before it ends
        self._background: JointMotion | None = None  # asynchronous move, servo or speed
        self._asynchronous = False  # the background motion reports its progress
        self._writes = self._operations = 0
        self._report_progress(running=False)
        self._answer(READY)
        self._commands: Mapping[int, Callable[[], None]] = {
            1: self._move_joints,
            2: self._move_joints_to_pose,
            3: self._move_line,
            4: self._move_line_to_joints,
            9: self._speed_joints,
            10: self._speed_line,
            11: self._servo_joints,
            15: self._speed_stop,
            16: self._servo_stop,
            17: self._payload,
            24: self._servo_line,
            29: self._set_tcp,
            30: self._inverse_near,
            31: self._protective_stop,
            33: self._stop_line,
            34: self._stop_joints,
            35: self._watchdog,
            43: self._forward,
            44: self._forward_of,
            46: self._inverse,
            47: self._steady,
        }

    def cycle(self, step_s: float, speed_fraction: float) -> bool:
        """One controller cycle; False when the program has ended by command.

        raises  ScriptError: an unreachable target, or a command that is not emulated
        """
        try:
            if self._blocking is not None:
                if self._blocking.step(self._joints, step_s, speed_fraction):
                    return True
                self._blocking = None
                self._answer(DONE)
            command = self._int(0)
            if command == _STOP_SCRIPT:
                return False
            self._process(command)
            if self._blocking is None:
                self._move_in_background(step_s, speed_fraction)
        except OutOfReachError as error:
            raise ScriptError(f"inverse kinematics: {error}") from error
        return True

    def _process(self, command: int) -> None:
        if command == 0:
            self._executing = False
            self._answer(READY)
        elif command in _REAL_TIME:
            self._run(command)
            self._answer(READY)
        elif not self._executing:
            self._executing = True
            self._run(command)
            if self._blocking is None:
                self._answer(DONE)

    def _run(self, command: int) -> None:
        action = self._commands.get(command)
        if action is None:
            raise ScriptError(f"command {command} is not emulated")
        action()

    def _move_in_background(self, step_s: float, speed_fraction: float) -> None:
        if self._background is None:
            self._joints.rest()
        elif not self._background.step(self._joints, step_s, speed_fraction):
            self._end_background()

    def _end_background(self) -> None:
        self._background = None
        if self._asynchronous:
            self._asynchronous = False
            self._report_progress(running=False)

    # --- registers ----------------------------------------------------------------------------

    def _int(self, index: int) -> int:
        return self._registers.int_in[self._offset + index]

    def _double(self, index: int) -> float:
        return self._registers.double_in[self._offset + index]

    def _vector(self, index: int = 0) -> FloatArray:
        start = self._offset + index
        return np.array(self._registers.double_in[start : start + 6])

    def _answer(self, value: int) -> None:
        self._registers.int_out[self._offset] = value

    def _write(self, values: FloatArray) -> None:
        for i, value in enumerate(values):
            self._registers.double_out[self._offset + i] = float(value)

    def _report_progress(self, running: bool) -> None:
        self._writes = (self._writes + 1) % 128
        if running:
            self._operations = (self._operations + 1) % 128
        value = self._operations << 24 | self._writes << 16 | (0x8000 if running else 0)
        self._registers.int_out[self._offset + 2] = value

    # --- commands -----------------------------------------------------------------------------

    def _start_move(self, move: JointMotion) -> None:
        self._end_background()
        if self._int(1) == 1:
            self._background, self._asynchronous = move, True
            self._report_progress(running=True)
        else:
            self._blocking = move

    def _move_joints(self) -> None:
        self._start_move(MoveJoints(self._joints, self._vector(), *self._limits()))

    def _move_joints_to_pose(self) -> None:
        target = self._joints.joints_at(matrix_of(self._vector()))
        self._start_move(MoveJoints(self._joints, target, *self._limits()))

    def _move_line(self) -> None:
        self._start_move(MoveLine(self._joints, matrix_of(self._vector()), *self._limits()))

    def _move_line_to_joints(self) -> None:
        target = self._joints.model.forward(self._vector(), self._joints.X_FT)
        self._start_move(MoveLine(self._joints, target, *self._limits()))

    def _limits(self) -> tuple[float, float]:
        return self._double(6), self._double(7)

    def _servo_joints(self) -> None:
        self._background = Servo(self._vector(), self._double(9))

    def _servo_line(self) -> None:
        target = self._joints.joints_at(matrix_of(self._vector()))
        self._background = Servo(target, self._double(9))

    def _speed_joints(self) -> None:
        self._background = Speed(self._vector(), *self._limits(), in_joints=True)

    def _speed_line(self) -> None:
        self._background = Speed(self._vector(), *self._limits(), in_joints=False)

    def _speed_stop(self) -> None:
        self._stop(in_joints=False)

    def _servo_stop(self) -> None:
        self._effects.note("servo stop")
        self._stop(in_joints=False)

    def _stop_line(self) -> None:
        self._stop(in_joints=False)

    def _stop_joints(self) -> None:
        self._stop(in_joints=True)

    def _stop(self, in_joints: bool) -> None:
        self._end_background()
        self._blocking = Decelerate(max(self._double(0), 1e-3), in_joints)

    def _payload(self) -> None:
        self._effects.set_payload(self._double(0))

    def _set_tcp(self) -> None:
        self._joints.X_FT = matrix_of(self._vector())

    def _inverse(self) -> None:
        self._write(self._joints.joints_at(matrix_of(self._vector())))

    def _inverse_near(self) -> None:
        self._write(
            self._joints.model.inverse(
                matrix_of(self._vector()), self._vector(6), self._joints.X_FT
            )
        )

    def _forward(self) -> None:
        self._write(pose_of(self._joints.tool()))

    def _forward_of(self) -> None:
        tool = matrix_of(self._vector(6))
        self._write(pose_of(self._joints.model.forward(self._vector(), tool)))

    def _protective_stop(self) -> None:
        self._effects.protective_stop("the program asked for it")

    def _watchdog(self) -> None:
        self._effects.watch(self._offset, self._double(0))

    def _steady(self) -> None:
        still = float(np.max(np.abs(self._joints.qd_rad_per_s))) < 1e-6
        self._registers.int_out[self._offset + 1] = int(still)
