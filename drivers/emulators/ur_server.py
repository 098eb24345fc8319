"""A UR controller on TCP: RTDE, script upload, dashboard, and a door for faults and signals.

    python -m drivers.emulators.ur_server --host 127.0.0.2

Its own process, because ur-rtde holds the interpreter's lock while it waits for the controller.
Several run side by side on different addresses 127.0.0.x.  It ends when its standard input does,
so that it never outlives whoever started it.  PolyScope X, from version 10 on, has no dashboard.

Faults come as lines of JSON on port 39999, `{"op": "protective_stop"}`; see `ur_ports.PortFaults`.
There the digital inputs are set, `{"op": "inputs", "bits": 5}`, and `{"op": "outputs"}` read.
"""

from __future__ import annotations

import argparse
import os
import selectors
import socket
import sys
import time
from dataclasses import replace

from drivers.emulators.ur_arm import HOME_RAD
from drivers.emulators.ur_controller import CYCLE_S, Controller, ControllerOptions
from drivers.emulators.ur_ports import PORTS, PortConnection, PortFaults, Rtde
from drivers.priority import run_in_real_time
from drivers.rtde_wire import DASHBOARD_PORT, FAULT_PORT, RTDE_PORT, SCRIPT_PORT, WireError
from drivers.ur_kinematics import MODELS, load_code
from drivers.ur_versions import has_dashboard, read_version

_RESYNC_S = 0.1


class UrServer:
    """Serves one controller on one address, one 2 ms cycle after the other, in one thread."""

    def __init__(self, host: str, options: ControllerOptions) -> None:
        self.controller = Controller(options)
        self._host = host
        # epoll would round the wait for the next cycle up to a whole millisecond
        self._selector = selectors.SelectSelector()
        self._connections: list[PortConnection] = []
        self._listeners: dict[int, socket.socket] = {}
        self._frozen_until_s = 0.0
        self._listen_again_s: float | None = None
        load_code()
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

    def claimed_by_others(self, me: PortConnection) -> set[str]:
        """Input variables claimed by other clients."""
        others = [c for c in self._connections if isinstance(c, Rtde) and c is not me]
        return set().union(*(c.inputs() for c in others)) if others else set()

    # --- faults -------------------------------------------------------------------------------

    def drop(self, ports: tuple[int, ...] = (RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT)) -> None:
        """Close the connections of these ports."""
        kinds = tuple(PORTS[p] for p in ports)
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
            if isinstance(connection, Rtde):
                connection.send(os.urandom(size))

    def power_cycle(self, seconds: float) -> None:
        """Switch off, and on again after a while."""
        self.drop()
        self._stop_listening()
        self.controller.power_off()
        self._listen_again_s = time.monotonic() + seconds

    def become(self, version: str) -> None:
        """Have other software from now on: major.minor.bugfix.build."""
        options = self.controller.options
        self.controller.options = replace(options, version=read_version(version))
        self.drop()
        self._stop_listening()
        self._listen()

    # --- network ------------------------------------------------------------------------------

    def _listen(self) -> None:
        version = self.controller.options.version
        for port in PORTS:
            if port == DASHBOARD_PORT and not has_dashboard(version[:2]):
                continue
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
        connection = PORTS[port](sock, self)
        self._connections.append(connection)
        self._selector.register(sock, selectors.EVENT_READ, connection)

    def _read(self, connection: PortConnection) -> None:
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

    def _frozen(self, connection: PortConnection) -> bool:
        return not isinstance(connection, PortFaults) and time.monotonic() < self._frozen_until_s

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

    def _close(self, connection: PortConnection) -> None:
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
    start = arguments.start_rad
    options = ControllerOptions(
        read_version(arguments.version),
        MODELS[arguments.model],
        arguments.time_scale,
        start_rad=HOME_RAD if start is None else tuple(float(q) for q in start.split(",")),
    )
    try:
        server = UrServer(arguments.host, options)
    except OSError as error:  # in place of "ready"
        print(f"did not start: {error.strerror}; does another `cell emulate` run?", flush=True)
        raise SystemExit(1) from None
    run_in_real_time(30)  # before its clients: they do not hold a real controller up either
    print("ready", flush=True)
    server.run_until_stdin_ends()


if __name__ == "__main__":
    main()
