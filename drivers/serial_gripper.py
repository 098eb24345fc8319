"""Robotiq-type gripper (2F-85) over Modbus RTU on a serial line.

source  Robotiq, "2F-85 & 2F-140 Instruction Manual", Modbus RTU communication: command registers
        from 0x3E8, status registers from 0x7D0
"""

from __future__ import annotations

import termios
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import minimalmodbus
import serial

from drivers.interfaces import Clock, DeviceLostError
from drivers.robotiq_gripper import GripperAction, GripperStatus, RobotiqGripper, RobotiqOptions

T = TypeVar("T")

_COMMAND, _STATUS = 0x3E8, 0x7D0
#: Errors of a lost line: pyserial's own, and one that it does not catch.
_LINE_ERRORS = (OSError, termios.error)
_LOST_REMEDY = "check the gripper's cable, power, address and baud rate, then reset"


@dataclass(frozen=True)
class SerialGripperOptions(RobotiqOptions):
    """Connection and motion of the gripper.

    port      device of the line, or a URL that pyserial knows: socket://host:port
    reply_s   time that an answer may take
    attempts  number of requests before the gripper counts as lost
    """

    port: str
    address: int = 9
    baud: int = 115_200
    reply_s: float = 0.035
    attempts: int = 2


class SerialGripper(RobotiqGripper):
    """A gripper on a serial line."""

    def __init__(self, options: SerialGripperOptions, clock: Clock, name: str = "gripper") -> None:
        super().__init__(options, clock, name, options.port, _LOST_REMEDY)
        self._options = options
        self._bus: minimalmodbus.Instrument | None = None

    def close(self) -> None:
        """Close the line, leaving the jaws as they are."""
        with self._lock:
            bus, self._bus = self._bus, None
            if bus is not None:
                bus.serial.close()

    def _open(self) -> None:
        options = self._options
        try:
            line = serial.serial_for_url(
                options.port, baudrate=options.baud, timeout=options.reply_s
            )
        except termios.error as error:
            raise OSError(str(error)) from error
        self._bus = minimalmodbus.Instrument(line, options.address)
        self._bus.clear_buffers_before_each_transaction = True

    def _status(self) -> GripperStatus:
        first, second, third = self._transact(lambda bus: bus.read_registers(_STATUS, 3))
        status = first >> 8
        return GripperStatus(
            activation=status >> 4 & 3,
            object=status >> 6 & 3,
            going=bool(status >> 3 & 1),
            fault=second >> 8,
            requested=second & 0xFF,
            count=third >> 8,
        )

    def _act(self, action: GripperAction) -> None:
        request = (action.active | action.going << 3) << 8
        registers = [request, action.count, action.speed << 8 | action.force]
        self._transact(lambda bus: bus.write_registers(_COMMAND, registers))

    def _transact(self, request: Callable[[minimalmodbus.Instrument], T]) -> T:
        """Send a request, again after a bad or missing answer.  Raises DeviceLostError."""
        with self._lock:
            if self._bus is None:
                raise DeviceLostError(self.name, "not connected", "connect first")
            for attempt in range(1, self._options.attempts + 1):
                try:
                    return request(self._bus)
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
