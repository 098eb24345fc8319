"""The Real-Time Data Exchange protocol, version 2, as bytes: packets, types and recipes.

source  Universal Robots, "Real-Time Data Exchange (RTDE) Guide"
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT, FAULT_PORT = 30004, 30003, 29999, 39999


Value = float | int | Sequence[float] | Sequence[int]

_HEADER = struct.Struct(">HB")

#: Type name → (struct format, number of elements).
TYPES: Mapping[str, tuple[str, int]] = {
    "BOOL": ("?", 1),
    "UINT8": ("B", 1),
    "UINT32": ("I", 1),
    "UINT64": ("Q", 1),
    "INT32": ("i", 1),
    "DOUBLE": ("d", 1),
    "VECTOR3D": ("3d", 3),
    "VECTOR6D": ("6d", 6),
    "VECTOR6INT32": ("6i", 6),
    "VECTOR6UINT32": ("6I", 6),
}

REGISTERS = 48


def _named(kind: str, names: str) -> dict[str, str]:
    return dict.fromkeys(names.split(), kind)


#: Variables that a controller can report, with their types.
OUTPUTS: Mapping[str, str] = {
    **_named(
        "VECTOR6D",
        "target_q target_qd target_qdd target_current target_moment actual_q actual_qd "
        "actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force "
        "target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage ft_raw_wrench "
        "payload_inertia",
    ),
    **_named("VECTOR3D", "actual_tool_accelerometer payload_cog elbow_position elbow_velocity"),
    **_named(
        "DOUBLE",
        "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum "
        "actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0 "
        "standard_analog_input1 standard_analog_output0 standard_analog_output1 payload",
    ),
    **_named("UINT64", "actual_digital_input_bits actual_digital_output_bits"),
    **_named("UINT32", "runtime_state robot_status_bits safety_status_bits"),
    **_named("INT32", "robot_mode safety_mode safety_status"),
    **_named("VECTOR6INT32", "joint_mode"),
    **{f"output_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"output_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
}

#: Variables that a client can write, with their types.
INPUTS: Mapping[str, str] = {
    **{f"input_int_register_{i}": "INT32" for i in range(REGISTERS)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)},
    **_named(
        "UINT8",
        "standard_digital_output_mask standard_digital_output configurable_digital_output_mask "
        "configurable_digital_output tool_digital_output_mask tool_digital_output "
        "standard_analog_output_mask standard_analog_output_type",
    ),
    **_named("UINT32", "speed_slider_mask"),
    **_named("DOUBLE", "speed_slider_fraction standard_analog_output_0 standard_analog_output_1"),
    **_named("VECTOR6D", "external_force_torque"),
}


class PackageType(IntEnum):
    """Type of a packet: codes of the RTDE guide."""

    PROTOCOL_VERSION = 86
    CONTROLLER_VERSION = 118
    TEXT = 77
    DATA = 85
    OUTPUT_SETUP = 79
    INPUT_SETUP = 73
    START = 83
    PAUSE = 80


class WireError(ValueError):
    """Bytes that are no packet."""


@dataclass(frozen=True)
class Packet:
    """One packet without its header."""

    kind: int
    payload: bytes = b""

    def encoded(self) -> bytes:
        """Header and payload.  Raises WireError: longer than the size field can say."""
        size = _HEADER.size + len(self.payload)
        if size > 0xFFFF:
            raise WireError(f"a packet of {size} bytes; at most 65535")
        return _HEADER.pack(size, self.kind) + self.payload


class Splitter:
    """Cuts a stream of bytes into packets, however it was divided on the way."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[Packet]:
        """Packets completed by `data`.  Raises WireError: the stream cannot be RTDE."""
        self._rest += data
        packets = []
        while len(self._rest) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._rest)
            if size < _HEADER.size:
                raise WireError(f"a packet of {size} bytes; at least {_HEADER.size}")
            if len(self._rest) < size:
                break
            packets.append(Packet(kind, bytes(self._rest[_HEADER.size : size])))
            del self._rest[:size]
        return packets


@dataclass(frozen=True)
class Recipe:
    """Variables that travel together, in this order, behind the number of their recipe."""

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]

    @cached_property
    def _full_format(self) -> struct.Struct:
        return struct.Struct(">B" + "".join(TYPES[t][0] for t in self.types))

    def encoded(self, values: Iterable[Value]) -> bytes:
        """Payload of a data packet."""
        flat: list[float | int] = [self.number]
        for value, kind in zip(values, self.types, strict=True):
            if TYPES[kind][1] == 1:
                flat.append(value)  # type: ignore[arg-type]  # by its type it is one number
            else:
                flat.extend(value)  # type: ignore[arg-type]
        return self._full_format.pack(*flat)

    def decoded(self, payload: bytes) -> dict[str, Value]:
        """Values by name; ur-rtde truncates some packets: they have their complete values only."""
        if len(payload) == self._full_format.size:
            flat = self._full_format.unpack(payload)
            return {name: flat[place] for name, place in self._places}
        values: dict[str, Value] = {}
        offset = 1
        for name, kind in zip(self.names, self.types, strict=True):
            form, count = TYPES[kind]
            size = struct.calcsize(">" + form)
            if offset + size > len(payload):
                break
            parts = struct.unpack_from(">" + form, payload, offset)
            values[name] = parts[0] if count == 1 else parts
            offset += size
        return values

    @cached_property
    def _places(self) -> tuple[tuple[str, int | slice], ...]:
        """Position of each variable among the numbers of a complete packet."""
        places: list[tuple[str, int | slice]] = []
        begin = 1
        for name, kind in zip(self.names, self.types, strict=True):
            count = TYPES[kind][1]
            places.append((name, begin if count == 1 else slice(begin, begin + count)))
            begin += count
        return tuple(places)


def names_in(payload: bytes) -> tuple[str, ...]:
    """Variable names of a set-up request: comma separated, often with a trailing comma."""
    return tuple(n for n in payload.decode("ascii", errors="replace").split(",") if n)
