"""Protocols of the emulated UR controller's ports, and of the emulator's own port for faults."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import socket
import struct
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from drivers.emulators.ur_controller import CYCLE_S, Controller
from drivers.rtde_wire import (
    DASHBOARD_PORT,
    FAULT_PORT,
    INPUTS,
    OUTPUTS,
    RTDE_PORT,
    SCRIPT_PORT,
    PackageType,
    Packet,
    Recipe,
    Splitter,
    Value,
    names_in,
)

_RTDE_HZ = 1.0 / CYCLE_S
_MAX_BACKLOG = 65536  # a slow reader loses packets rather than time


class PortServer(Protocol):
    """Interface of the server that a connection belongs to."""

    controller: Controller

    def claimed_by_others(self, me: PortConnection) -> set[str]:
        """Input variables claimed by other clients."""
        ...

    def drop(self, ports: tuple[int, ...] = ...) -> None:
        """Close the connections of these ports."""
        ...

    def freeze(self, seconds: float) -> None:
        """Neither read nor send for a while."""
        ...

    def refuse(self, on: bool) -> None:
        """Refuse new connections, or accept them again."""
        ...

    def send_garbage(self, size: int = ...) -> None:
        """Send random bytes to every RTDE client."""
        ...

    def power_cycle(self, seconds: float) -> None:
        """Switch off, and on again after a while."""
        ...

    def become(self, version: str) -> None:
        """Have other software from now on."""
        ...


class PortConnection:
    """One client of one port."""

    def __init__(self, sock: socket.socket, server: PortServer) -> None:
        self.sock = sock
        self.server = server
        self.unsent = b""

    def receive(self, data: bytes) -> None:
        """Act on bytes from the client."""

    def cycle(self, number: int) -> None:
        """Send the reports that are due in this controller cycle."""

    def send(self, data: bytes) -> None:
        """Send without ever waiting."""
        self.unsent += data
        with contextlib.suppress(BlockingIOError):
            sent = self.sock.send(self.unsent)
            self.unsent = self.unsent[sent:]


class _Lines(PortConnection):
    """A client that talks in lines."""

    def __init__(self, sock: socket.socket, server: PortServer) -> None:
        super().__init__(sock, server)
        self._rest = b""

    def receive(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self.line(line.decode("utf-8", errors="replace"))

    def line(self, text: str) -> None:
        """Act on one line."""
        raise NotImplementedError


class _Dashboard(_Lines):
    def __init__(self, sock: socket.socket, server: PortServer) -> None:
        super().__init__(sock, server)
        self.send(b"Connected: Universal Robots Dashboard Server\n")

    def line(self, text: str) -> None:
        self.send((self.server.controller.dashboard(text) + "\n").encode())


class _Script(_Lines):
    """Collects a program from its `def` to the `end` in the first column."""

    def __init__(self, sock: socket.socket, server: PortServer) -> None:
        super().__init__(sock, server)
        self._program: list[str] = []

    def line(self, text: str) -> None:
        if self._program or text.startswith(("def ", "sec ")):
            self._program.append(text)
            if text.rstrip() == "end":
                self.server.controller.upload("\n".join(self._program))
                self._program = []
        elif text.strip():
            self.server.controller.upload(text)


class Rtde(PortConnection):
    """An RTDE client: negotiates recipes, then gets one packet per cycle and sends inputs."""

    def __init__(self, sock: socket.socket, server: PortServer) -> None:
        super().__init__(sock, server)
        self._splitter = Splitter()
        self._output: Recipe | None = None
        self._read: Callable[[], list[Value]] = list
        self._every = 1
        self._inputs: dict[int, Recipe] = {}
        self._started = False

    def receive(self, data: bytes) -> None:
        """Answer packets."""
        # the client's Nagle algorithm would hold its next command back for a delayed ACK
        if hasattr(socket, "TCP_QUICKACK"):
            self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        for packet in self._splitter.feed(data):
            self._answer(packet)

    def cycle(self, number: int) -> None:
        """Send the outputs, if they are due."""
        if not self._started or self._output is None or number % self._every:
            return
        if len(self.unsent) < _MAX_BACKLOG:
            self._reply(PackageType.DATA, self._output.encoded(self._read()))

    def inputs(self) -> set[str]:
        """Input variables that this client has claimed."""
        return {name for recipe in self._inputs.values() for name in recipe.names}

    def _reply(self, kind: PackageType, payload: bytes) -> None:
        self.send(Packet(kind, payload).encoded())

    def _answer(self, packet: Packet) -> None:
        match packet.kind:
            case PackageType.DATA:
                recipe = self._inputs.get(packet.payload[0]) if packet.payload else None
                if recipe is not None:
                    self.server.controller.write(recipe.decoded(packet.payload))
            case PackageType.PROTOCOL_VERSION:
                self._reply(PackageType.PROTOCOL_VERSION, bytes([packet.payload == b"\x00\x02"]))
            case PackageType.CONTROLLER_VERSION:
                version = struct.pack(">4I", *self.server.controller.options.version)
                self._reply(PackageType.CONTROLLER_VERSION, version)
            case PackageType.OUTPUT_SETUP:
                self._set_up_outputs(packet.payload)
            case PackageType.INPUT_SETUP:
                self._set_up_inputs(packet.payload)
            case PackageType.START | PackageType.PAUSE:
                self._started = packet.kind == PackageType.START
                self._reply(PackageType(packet.kind), b"\x01")
            case _:
                self.server.controller.note(f"RTDE packet of unknown kind {packet.kind}")

    def _set_up_outputs(self, payload: bytes) -> None:
        (frequency_hz,) = struct.unpack_from(">d", payload)
        names = names_in(payload[8:])
        types = tuple(OUTPUTS.get(n, "NOT_FOUND") for n in names)
        if "NOT_FOUND" not in types:
            self._output = Recipe(1, names, types)
            self._read = self.server.controller.reader(names)
            self._every = max(1, round(_RTDE_HZ / min(_RTDE_HZ, max(1.0, frequency_hz))))
        self._reply(PackageType.OUTPUT_SETUP, b"\x01" + ",".join(types).encode())

    def _set_up_inputs(self, payload: bytes) -> None:
        names = names_in(payload)
        taken = self.server.claimed_by_others(self)
        types = tuple("IN_USE" if n in taken else INPUTS.get(n, "NOT_FOUND") for n in names)
        number = 0
        if not {"NOT_FOUND", "IN_USE"} & set(types):
            number = len(self._inputs) + 1
            self._inputs[number] = Recipe(number, names, types)
        self._reply(PackageType.INPUT_SETUP, bytes([number]) + ",".join(types).encode())


class PortFaults(_Lines):
    """Door for faults and digital signals: one JSON object per line in, one per line out."""

    def line(self, text: str) -> None:
        """Serve a request."""
        try:
            request = json.loads(text)
            answer = self._act(request.pop("op"), request)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        self.send((json.dumps(answer) + "\n").encode())

    def _act(self, op: str, request: dict[str, Any]) -> dict[str, Any]:
        server, controller = self.server, self.server.controller
        actions: Mapping[str, Callable[..., None]] = {
            "protective_stop": lambda: controller.protective_stop("injected"),
            "safeguard_stop": controller.safeguard_stop,
            "emergency_stop": controller.emergency_stop,
            "clear": controller.clear_safety,
            "home": controller.put_home,
            "end_program": lambda: controller.end_program("injected"),
            "local": lambda on: setattr(controller, "remote_control", not on),
            "speed_fraction": lambda value: setattr(controller, "speed_fraction", float(value)),
            "speed_scaling": lambda value: setattr(controller, "speed_scaling", float(value)),
            "brakes": lambda on: setattr(controller, "robot_mode", 5 if on else 7),
            "drop": server.drop,
            "freeze": server.freeze,
            "refuse": server.refuse,
            "garbage": server.send_garbage,
            "power_cycle": server.power_cycle,
            "version": server.become,
            "inputs": controller.set_inputs,
            "hold_outputs": lambda mask: setattr(controller, "held_outputs", int(mask)),
        }
        if op == "state":
            return _state_of(controller)
        if op == "outputs":
            return {"bits": controller.digital_outputs}
        if op == "servo_gaps":
            gaps_s = list(controller.servo_gaps_s)
            controller.servo_gaps_s.clear()
            return {"gaps_s": gaps_s}
        actions[op](**request)
        return {"t_s": time.monotonic()}


def _state_of(controller: Controller) -> dict[str, Any]:
    return {
        "t_s": time.monotonic(),
        "q_rad": controller.joints.q_rad.tolist(),
        "pose": list(controller.outputs(["actual_TCP_pose"])[0]),  # type: ignore[arg-type]
        "speed": controller.joints.tool_speed().tolist(),
        "runtime": controller.runtime.name,
        "safety": controller.safety.value,
        "last_moved_s": controller.last_moved_s,
        "servo_writes": controller.servo_writes,
        "dashboard_lines": controller.dashboard_lines,
        "events": [dataclasses.asdict(e) for e in controller.events],
    }


PORTS: Mapping[int, type[PortConnection]] = {
    RTDE_PORT: Rtde,
    SCRIPT_PORT: _Script,
    DASHBOARD_PORT: _Dashboard,
    FAULT_PORT: PortFaults,
}
