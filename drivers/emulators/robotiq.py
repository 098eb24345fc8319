"""A Robotiq 2F-85 on a pseudo terminal, for the unmodified pyserial, with faults.

source  Robotiq, "2F-85 & 2F-140 Instruction Manual"; Modbus over serial line V1.02
"""

from __future__ import annotations

import os
import pty
import select
import struct
import time
import tty
from dataclasses import dataclass, field
from typing import Self

from drivers.threads import GuardedThread, only_logged

_COMMAND, _STATUS, _REGISTERS = 0x3E8, 0x7D0, 3
_ACTIVATION_S = 0.3
_RATES = (20.0, 600.0)  # counts per second at speed 0 and 255
_CLOSED_COUNT = 230.0  # where empty jaws meet


@dataclass
class RobotiqFaults:
    """Faults of the emulated gripper; may be set at any time."""

    silent: bool = False
    bad_crc: bool = False
    garbage: bool = False
    jammed: bool = False  # the jaws neither move nor arrive
    fault_code: int = 0


@dataclass
class Jaws:
    """Registers and motion of the gripper, without its serial line.

    object_count  count at which the jaws meet an object; None = no object
    """

    object_count: float | None = None
    faults: RobotiqFaults = field(default_factory=RobotiqFaults)
    command: list[int] = field(default_factory=lambda: [0] * _REGISTERS)
    count: float = 3.0
    activation: int = 0
    object: int = 0
    _active_for_s: float = 0.0

    def advance(self, passed_s: float) -> None:
        """Let time pass."""
        action = self.command[0] >> 8
        if not action & 1:
            self.activation, self._active_for_s = 0, 0.0
            return
        self._active_for_s += passed_s
        self.activation = 3 if self._active_for_s >= _ACTIVATION_S else 1
        if self.activation != 3 or not action >> 3 & 1:
            return
        if self.faults.jammed:
            self.object = 0
            return
        requested = float(self.command[1] & 0xFF)
        target = min(requested, _CLOSED_COUNT)
        if self.object_count is not None and self.count <= self.object_count:
            target = min(target, self.object_count)
        slow, fast = _RATES
        step = (slow + (fast - slow) * (self.command[2] >> 8) / 255.0) * passed_s
        self.count += max(-step, min(step, target - self.count))
        if abs(self.count - target) > 0.5:
            self.object = 0
        else:
            self.object = 2 if target < min(requested, _CLOSED_COUNT) else 3

    @property
    def holds(self) -> bool:
        """Whether something is between the closed jaws."""
        return self.object_count is not None and self.count >= self.object_count - 0.5

    def read(self, address: int) -> int:
        """A register.  Raises IndexError: there is none."""
        if 0 <= address - _COMMAND < _REGISTERS:
            return self.command[address - _COMMAND]
        if not 0 <= address - _STATUS < _REGISTERS:
            raise IndexError(address)
        action = self.command[0] >> 8 & 0b1001
        status = action | self.activation << 4 | self.object << 6
        requested = self.command[1] & 0xFF
        return (status << 8, self.faults.fault_code << 8 | requested, round(self.count) << 8)[
            address - _STATUS
        ]

    def write(self, address: int, values: list[int]) -> None:
        """Command registers.  Raises IndexError: others."""
        first = address - _COMMAND
        if first < 0 or first + len(values) > _REGISTERS:
            raise IndexError(address)
        before = self.command[1] & 0xFF
        self.command[first : first + len(values)] = values
        if self.command[1] & 0xFF != before:
            self.object = 0


def crc16(data: bytes) -> bytes:
    """Modbus checksum, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return struct.pack("<H", crc)


def frame_size(data: bytes) -> int | None:
    """Size of the request that begins with `data`; None while too few bytes are there."""
    if len(data) < 2:
        return None
    if data[1] == 16:
        return 9 + data[6] if len(data) > 6 else None
    if data[1] == 23:
        return 13 + data[10] if len(data) > 10 else None
    return 8


def reply(jaws: Jaws, request: bytes) -> bytes:
    """Answer to a request, both without checksum."""
    unit, function = request[0], request[1]
    try:
        if function in (3, 4):
            first, count = struct.unpack_from(">HH", request, 2)
            return request[:2] + _listed(jaws, first, count)
        if function == 6:
            address, value = struct.unpack_from(">HH", request, 2)
            jaws.write(address, [value])
            return request
        if function == 16:
            first, count = struct.unpack_from(">HH", request, 2)
            jaws.write(first, list(struct.unpack_from(f">{count}H", request, 7)))
            return request[:6]
        if function == 23:
            first, count, to, number = struct.unpack_from(">4H", request, 2)
            jaws.write(to, list(struct.unpack_from(f">{number}H", request, 11)))
            return request[:2] + _listed(jaws, first, count)
    except (IndexError, struct.error):
        return bytes([unit, function | 0x80, 2])
    return bytes([unit, function | 0x80, 1])


def _listed(jaws: Jaws, first: int, count: int) -> bytes:
    values = [jaws.read(first + i) for i in range(count)]
    return bytes([2 * count]) + struct.pack(f">{count}H", *values)


class EmulatedGripper:
    """The gripper on a pseudo terminal `port`, served by a thread within a `with`."""

    #: Where the jaws meet a cable.
    CABLE_COUNT = 200.0

    def __init__(self, address: int = 9, object_count: float | None = CABLE_COUNT) -> None:
        self.jaws = Jaws(object_count)
        self._address = address
        # the slave end stays open: without any opener, reading the master fails
        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._wake, self._waker = os.pipe()
        self._thread = GuardedThread("robotiq", self._serve, only_logged)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()
        os.close(self._wake)
        os.close(self._waker)

    def unplug(self) -> None:
        """Pull the cable: the terminal vanishes.  Safe to call twice."""
        if self._thread.is_alive():
            os.write(self._waker, b"!")
            self._thread.join()
            os.close(self._slave)
            os.close(self._master)

    def _serve(self) -> None:
        pending, before_s = b"", time.monotonic()
        while True:
            ready, _, _ = select.select([self._master, self._wake], [], [], 0.01)
            now_s = time.monotonic()
            self.jaws.advance(now_s - before_s)
            before_s = now_s
            if self._wake in ready:
                return
            if not ready:
                pending = b""  # silence ends a frame
                continue
            pending += os.read(self._master, 256)
            size = frame_size(pending)
            if size is not None and len(pending) >= size:
                self._answer(pending[:size])
                pending = pending[size:]

    def _answer(self, frame: bytes) -> None:
        faults = self.jaws.faults
        if crc16(frame[:-2]) != frame[-2:] or frame[0] != self._address or faults.silent:
            return
        answer = reply(self.jaws, frame[:-2])
        answer += crc16(answer)
        if faults.bad_crc:
            answer = answer[:-1] + bytes([answer[-1] ^ 0xFF])
        if faults.garbage:
            answer = os.urandom(len(answer))
        os.write(self._master, answer)
