"""Robotiq-type gripper (2F-85) over Modbus RTU on a serial line.

source  Robotiq, "2F-85 & 2F-140 Instruction Manual", Modbus RTU communication: command registers
        from 0x3E8, status registers from 0x7D0

The gripper itself decides whether something is between its jaws, by being stopped before they
meet.  It cannot tell 0.1 mm from nothing: the fingertips must be made so that empty jaws close
further than jaws on a cable.
"""

from __future__ import annotations

import logging
import termios
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import minimalmodbus
import serial

from drivers.interfaces import (
    Clock,
    ConnectError,
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
    GripError,
    GripperState,
    LimitError,
)

T = TypeVar("T")

_LOG = logging.getLogger(__name__)

_COMMAND, _STATUS = 0x3E8, 0x7D0
_ACTIVATE, _GO_TO = 0x0100, 0x0800
_ACTIVE = 3
_MOVING, _STOPPED_CLOSING = 0, 2

_FAULTS = {
    0x05: "action delayed until the activation is complete",
    0x07: "not activated",
    0x08: "too hot",
    0x09: "no communication for 1 s",
    0x0A: "supply voltage too low",
    0x0B: "automatic release in progress",
    0x0C: "internal fault",
    0x0D: "activation fault: something blocks the jaws",
    0x0E: "overcurrent",
    0x0F: "automatic release completed",
}
#: Codes from the first on hinder a motion; those from the second on end only with an activation.
_FAULT, _NEEDS_ACTIVATION = 0x08, 0x0A
#: What a line that has gone raises: pyserial's own errors, and one that it lets through.
_LINE_ERRORS = (OSError, termios.error)
_LOST_REMEDY = "check the gripper's cable, power, address and baud rate, then connect again"


@dataclass(frozen=True)
class SerialGripperOptions:
    """How the gripper is reached and what its registers mean.

    port          device of the line, or a URL that pyserial knows: socket://host:port
    reply_s       time that an answer may take
    attempts      how often a question is asked before the gripper counts as lost
    motion_s      time that a motion or the activation may take
    stroke_m      opening at count 0
    closed_count  count at which empty jaws meet
    force_n       forces of the counts 0 and 255
    """

    port: str
    address: int = 9
    baud: int = 115_200
    reply_s: float = 0.035
    attempts: int = 2
    motion_s: float = 5.0
    poll_s: float = 0.005
    stroke_m: float = 0.085
    closed_count: int = 230
    force_n: tuple[float, float] = (20.0, 235.0)


@dataclass(frozen=True)
class _Status:
    """Status registers, decoded."""

    activation: int
    object: int
    going: bool
    fault: int
    requested: int
    count: int

    @classmethod
    def of(cls, registers: list[int]) -> _Status:
        status = registers[0] >> 8
        return cls(
            activation=status >> 4 & 3,
            object=status >> 6 & 3,
            going=bool(status >> 3 & 1),
            fault=registers[1] >> 8,
            requested=registers[1] & 0xFF,
            count=registers[2] >> 8,
        )

    @property
    def moving(self) -> bool:
        return self.going and self.object == _MOVING

    @property
    def holding(self) -> bool:
        return self.going and self.object == _STOPPED_CLOSING


class SerialGripper:
    """A gripper on a serial line.  Any thread may ask for its state."""

    def __init__(self, options: SerialGripperOptions, clock: Clock, name: str = "gripper") -> None:
        self.name = name
        self._options = options
        self._clock = clock
        self._bus: minimalmodbus.Instrument | None = None
        self._lock = threading.RLock()

    def connect(self) -> None:
        """Open the line and activate, unless it is active: activation would open the jaws.

        Raises ConnectError.
        """
        options = self._options
        with self._lock:
            self.close()
            try:
                line = serial.serial_for_url(
                    options.port, baudrate=options.baud, timeout=options.reply_s
                )
                bus = minimalmodbus.Instrument(line, options.address)
                bus.clear_buffers_before_each_transaction = True
                self._bus = bus
                if self._status().activation != _ACTIVE:
                    self._activate()
            except (*_LINE_ERRORS, DeviceError) as error:
                self.close()
                cause = error.cause if isinstance(error, DeviceError) else str(error)
                raise ConnectError(
                    self.name, f"no gripper on {options.port}: {cause}", _LOST_REMEDY
                ) from error
        _LOG.info("%s: connected on %s", self.name, options.port)

    def close(self) -> None:
        """Close the line, leaving the jaws as they are."""
        with self._lock:
            bus, self._bus = self._bus, None
            if bus is not None:
                bus.serial.close()

    def grip(self, force_n: float) -> GripperState:
        """Raises LimitError: not a force of this gripper; GripError; DeviceTimeoutError."""
        low, high = self._options.force_n
        if not low <= force_n <= high:
            raise LimitError(
                self.name, f"force = {force_n} N, allowed {low}..{high} N", "nothing was moved"
            )
        _LOG.info("%s: grip with %g N", self.name, force_n)
        state = self._move(255, round(255 * (force_n - low) / (high - low)))
        if not state.holding:
            raise GripError(
                self.name, "nothing between the jaws", "present a cable at the grasping place"
            )
        return state

    def release(self) -> GripperState:
        """Raises DeviceTimeoutError; DeviceLostError."""
        _LOG.info("%s: release", self.name)
        return self._move(0, 0)

    def state(self) -> GripperState:
        """Raises DeviceLostError."""
        status = self._status()
        return GripperState(
            self._clock.now_s(), self._opening_m(status.count), status.holding, status.moving
        )

    def _opening_m(self, count: int) -> float:
        return self._options.stroke_m * max(0.0, 1.0 - count / self._options.closed_count)

    def _activate(self) -> None:
        self._write([0, 0, 0])
        self._write([_ACTIVATE, 0, 0])
        self._wait(lambda status: status.activation == _ACTIVE, "activation")

    def _move(self, count: int, force_count: int) -> GripperState:
        with self._lock:
            self._write([_ACTIVATE | _GO_TO, count, 0xFF00 | force_count])
            # the echo of the request tells the answer to this motion from that to the last one
            self._wait(lambda s: s.requested == count and s.going and not s.moving, "motion")
            return self.state()

    def _wait(self, done: Callable[[_Status], bool], what: str) -> None:
        until_s = self._clock.now_s() + self._options.motion_s
        while True:
            status = self._status()
            finished = done(status)
            # one that only an activation clears holds the jaws, whatever else the registers say
            if status.fault >= (_NEEDS_ACTIVATION if finished else _FAULT):
                reason = _FAULTS.get(status.fault, "unknown")
                raise DeviceError(
                    self.name, f"fault 0x{status.fault:02X}: {reason}", "clear it and connect again"
                )
            if finished:
                return
            if self._clock.now_s() > until_s:
                raise DeviceTimeoutError(
                    self.name,
                    f"{what} not finished within {self._options.motion_s:.1f} s",
                    "clear the jaws",
                )
            self._clock.sleep_s(self._options.poll_s)

    def _status(self) -> _Status:
        return _Status.of(self._ask(lambda bus: bus.read_registers(_STATUS, 3)))

    def _write(self, registers: list[int]) -> None:
        self._ask(lambda bus: bus.write_registers(_COMMAND, registers))

    def _ask(self, question: Callable[[minimalmodbus.Instrument], T]) -> T:
        """Ask, and ask again after a bad or missing answer.  Raises DeviceLostError."""
        with self._lock:
            if self._bus is None:
                raise DeviceLostError(self.name, "not connected", "connect first")
            for attempt in range(1, self._options.attempts + 1):
                try:
                    return question(self._bus)
                except minimalmodbus.ModbusException as error:
                    if attempt == self._options.attempts:
                        self.close()
                        raise DeviceLostError(
                            self.name, f"{error} ({attempt} attempts)", _LOST_REMEDY
                        ) from error
                except _LINE_ERRORS as error:
                    self.close()
                    raise DeviceLostError(
                        self.name, f"the serial line failed: {error}", _LOST_REMEDY
                    ) from error
            raise AssertionError("the loop above returns or raises")
