"""A UR controller on TCP: RTDE, script upload, dashboard, and a door for faults.

    python -m drivers.emulators.ur_server --host 127.0.0.2

Its own process, because ur-rtde holds the interpreter's lock while it waits for the controller.
Several run side by side on different addresses 127.0.0.x.  It ends when its standard input does,
so that it never outlives whoever started it.

Faults come as lines of JSON on port 39999, `{"op": "protective_stop"}`; see `_Faults`.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import selectors
import socket
import struct
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from drivers.emulators.rtde_wire import (
    INPUTS,
    OUTPUTS,
    Kind,
    Packet,
    Recipe,
    Splitter,
    WireError,
    names_in,
)
from drivers.emulators.ur_arm import HOME_RAD
from drivers.emulators.ur_controller import CYCLE_S, Controller, ControllerOptions
from drivers.priority import run_in_real_time
from drivers.ur_kinematics import MODELS

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT, FAULT_PORT = 30004, 30003, 29999, 39999

_RTDE_HZ = 1.0 / CYCLE_S
_MAX_BACKLOG = 65536  # a slow reader loses packets rather than time
_RESYNC_S = 0.1


class _Connection:
    """One client of one port."""

    def __init__(self, sock: socket.socket, server: UrServer) -> None:
        self.sock = sock
        self.server = server
        self.unsent = b""

    def receive(self, data: bytes) -> None:
        """Act on bytes from the client."""

    def cycle(self, number: int) -> None:
        """Say what is due in this controller cycle."""

    def send(self, data: bytes) -> None:
        """Send without ever waiting."""
        self.unsent += data
        with contextlib.suppress(BlockingIOError):
            sent = self.sock.send(self.unsent)
            self.unsent = self.unsent[sent:]


class _Lines(_Connection):
    """A client that talks in lines."""

    def __init__(self, sock: socket.socket, server: UrServer) -> None:
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
    def __init__(self, sock: socket.socket, server: UrServer) -> None:
        super().__init__(sock, server)
        self.send(b"Connected: Universal Robots Dashboard Server\n")

    def line(self, text: str) -> None:
        self.send((self.server.controller.dashboard(text) + "\n").encode())


class _Script(_Lines):
    """Collects a program from its `def` to the `end` in the first column."""

    def __init__(self, sock: socket.socket, server: UrServer) -> None:
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


class _Rtde(_Connection):
    """An RTDE client: negotiates recipes, then gets one packet per cycle and sends inputs."""

    def __init__(self, sock: socket.socket, server: UrServer) -> None:
        super().__init__(sock, server)
        self._splitter = Splitter()
        self._output: Recipe | None = None
        self._every = 1
        self._inputs: dict[int, Recipe] = {}
        self._started = False

    def receive(self, data: bytes) -> None:
        # the client's Nagle algorithm would hold its next command back for a delayed ACK
        if hasattr(socket, "TCP_QUICKACK"):
            self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        for packet in self._splitter.feed(data):
            self._answer(packet)

    def cycle(self, number: int) -> None:
        if not self._started or self._output is None or number % self._every:
            return
        if len(self.unsent) < _MAX_BACKLOG:
            values = self.server.controller.outputs(self._output.names)
            self._reply(Kind.DATA, self._output.encoded(values))

    def inputs(self) -> set[str]:
        """Input variables that this client has claimed."""
        return {name for recipe in self._inputs.values() for name in recipe.names}

    def _reply(self, kind: Kind, payload: bytes) -> None:
        self.send(Packet(kind, payload).encoded())

    def _answer(self, packet: Packet) -> None:
        match packet.kind:
            case Kind.DATA:
                recipe = self._inputs.get(packet.payload[0]) if packet.payload else None
                if recipe is not None:
                    self.server.controller.write(recipe.decoded(packet.payload))
            case Kind.PROTOCOL_VERSION:
                self._reply(Kind.PROTOCOL_VERSION, bytes([packet.payload == b"\x00\x02"]))
            case Kind.CONTROLLER_VERSION:
                version = struct.pack(">4I", *self.server.controller.options.version)
                self._reply(Kind.CONTROLLER_VERSION, version)
            case Kind.OUTPUT_SETUP:
                self._set_up_outputs(packet.payload)
            case Kind.INPUT_SETUP:
                self._set_up_inputs(packet.payload)
            case Kind.START | Kind.PAUSE:
                self._started = packet.kind == Kind.START
                self._reply(Kind(packet.kind), b"\x01")
            case _:
                self.server.controller.note(f"RTDE packet of unknown kind {packet.kind}")

    def _set_up_outputs(self, payload: bytes) -> None:
        (frequency_hz,) = struct.unpack_from(">d", payload)
        names = names_in(payload[8:])
        types = tuple(OUTPUTS.get(n, "NOT_FOUND") for n in names)
        if "NOT_FOUND" not in types:
            self._output = Recipe(1, names, types)
            self._every = max(1, round(_RTDE_HZ / min(_RTDE_HZ, max(1.0, frequency_hz))))
        self._reply(Kind.OUTPUT_SETUP, b"\x01" + ",".join(types).encode())

    def _set_up_inputs(self, payload: bytes) -> None:
        names = names_in(payload)
        taken = self.server.claimed_by_others(self)
        types = tuple("IN_USE" if n in taken else INPUTS.get(n, "NOT_FOUND") for n in names)
        number = 0
        if not {"NOT_FOUND", "IN_USE"} & set(types):
            number = len(self._inputs) + 1
            self._inputs[number] = Recipe(number, names, types)
        self._reply(Kind.INPUT_SETUP, bytes([number]) + ",".join(types).encode())


class _Faults(_Lines):
    """Door for faults: one JSON object per line in, one per line out."""

    def line(self, text: str) -> None:
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
        }
        if op == "state":
            return _state_of(controller)
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


_PORTS: Mapping[int, type[_Connection]] = {
    RTDE_PORT: _Rtde,
    SCRIPT_PORT: _Script,
    DASHBOARD_PORT: _Dashboard,
    FAULT_PORT: _Faults,
}


class UrServer:
    """Serves one controller on one address, one 2 ms cycle after the other, in one thread."""

    def __init__(self, host: str, options: ControllerOptions) -> None:
        self.controller = Controller(options)
        self._host = host
        # epoll would round the wait for the next cycle up to a whole millisecond
        self._selector = selectors.SelectSelector()
        self._connections: list[_Connection] = []
        self._listeners: dict[int, socket.socket] = {}
        self._frozen_until_s = 0.0
        self._listen_again_s: float | None = None
        self._listen()

    def run_until_stdin_ends(self) -> None:
        """Serve."""
        self._selector.register(sys.stdin, selectors.EVENT_READ)
        next_s, number = time.perf_counter() + CYCLE_S, 0
        try:
            while self._serve_until(next_s):
                number += 1
                self._cycle(number)
                next_s += CYCLE_S
                behind_s = time.perf_counter() - next_s
                if behind_s > _RESYNC_S:
                    missed = int(behind_s / CYCLE_S)
                    self.controller.miss(missed)
                    next_s += missed * CYCLE_S
        finally:
            self.drop()
            self._stop_listening()

    def claimed_by_others(self, me: _Connection) -> set[str]:
        """Input variables claimed by other clients."""
        others = [c for c in self._connections if isinstance(c, _Rtde) and c is not me]
        return set().union(*(c.inputs() for c in others)) if others else set()

    # --- faults -------------------------------------------------------------------------------

    def drop(self, ports: tuple[int, ...] = (RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT)) -> None:
        """Close the connections of these ports."""
        kinds = tuple(_PORTS[p] for p in ports)
        for connection in [c for c in self._connections if isinstance(c, kinds)]:
            self._close(connection)

    def freeze(self, seconds: float) -> None:
        """Neither read nor send for a while; the arm's own loop goes on."""
        self._frozen_until_s = time.monotonic() + seconds

    def refuse(self, on: bool) -> None:
        """Refuse new connections, or accept them again."""
        if on:
            self._stop_listening()
        else:
            self._listen()

    def send_garbage(self, size: int = 64) -> None:
        """Send random bytes to every RTDE client."""
        for connection in self._connections:
            if isinstance(connection, _Rtde):
                connection.send(os.urandom(size))

    def power_cycle(self, seconds: float) -> None:
        """Switch off, and on again after a while."""
        self.drop()
        self._stop_listening()
        self.controller.power_off()
        self._listen_again_s = time.monotonic() + seconds

    # --- network ------------------------------------------------------------------------------

    def _listen(self) -> None:
        for port in _PORTS:
            if port not in self._listeners:
                listener = socket.create_server((self._host, port), backlog=16)
                listener.setblocking(False)
                self._listeners[port] = listener
                self._selector.register(listener, selectors.EVENT_READ, port)

    def _stop_listening(self) -> None:
        """Close every door but the one for faults."""
        for port in [p for p in self._listeners if p != FAULT_PORT]:
            listener = self._listeners.pop(port)
            self._selector.unregister(listener)
            listener.close()

    def _serve_until(self, next_s: float) -> bool:
        """Serve the network until `next_s`; False when standard input has ended."""
        while True:
            left_s = next_s - time.perf_counter()
            for key, _ in self._selector.select(max(0.0, left_s)):
                if key.data is None:  # standard input
                    if not os.read(key.fd, 4096):
                        return False
                elif isinstance(key.data, int):
                    self._accept(key.data)
                else:
                    self._read(key.data)
            if time.perf_counter() >= next_s:
                return True

    def _accept(self, port: int) -> None:
        sock, _ = self._listeners[port].accept()
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = _PORTS[port](sock, self)
        self._connections.append(connection)
        self._selector.register(sock, selectors.EVENT_READ, connection)

    def _read(self, connection: _Connection) -> None:
        if self._frozen(connection):
            time.sleep(1e-4)  # its bytes stay where they are, so select would return at once
            return
        try:
            data = connection.sock.recv(65536)
            if data:
                connection.receive(data)
            else:
                self._close(connection)
        except BlockingIOError:
            return
        except (OSError, WireError) as error:
            self.controller.note(f"connection closed: {error}")
            self._close(connection)

    def _frozen(self, connection: _Connection) -> bool:
        return not isinstance(connection, _Faults) and time.monotonic() < self._frozen_until_s

    def _cycle(self, number: int) -> None:
        if self._listen_again_s is not None and time.monotonic() >= self._listen_again_s:
            self._listen_again_s = None
            self.controller.clear_safety()
            self._listen()
        self.controller.tick()
        for connection in list(self._connections):
            if not self._frozen(connection):
                try:
                    connection.cycle(number)
                    if connection.unsent:
                        connection.send(b"")
                except OSError:
                    self._close(connection)

    def _close(self, connection: _Connection) -> None:
        if connection in self._connections:
            self._connections.remove(connection)
            self._selector.unregister(connection.sock)
            connection.sock.close()


def main() -> None:
    """Serve one controller until standard input ends."""
    parser = argparse.ArgumentParser(description="Emulated UR controller on a loopback address.")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--version", default="5.12.2.1101534", help="PolyScope version")
    parser.add_argument("--model", default="UR5e", choices=sorted(MODELS))
    parser.add_argument("--time-scale", type=float, default=1.0)
    parser.add_argument("--start-rad", help="six joint angles at which the arm stands at first")
    arguments = parser.parse_args()
    if not arguments.host.startswith("127."):
        parser.error("an emulator serves loopback addresses only")
    major, minor, bugfix, build = (int(part) for part in arguments.version.split("."))
    start = arguments.start_rad
    options = ControllerOptions(
        (major, minor, bugfix, build),
        MODELS[arguments.model],
        arguments.time_scale,
        start_rad=HOME_RAD if start is None else tuple(float(q) for q in start.split(",")),
    )
    server = UrServer(arguments.host, options)
    run_in_real_time(30)  # before its clients: they do not hold a real controller up either
    print("ready", flush=True)
    server.run_until_stdin_ends()


if __name__ == "__main__":
    main()
