"""Small RTDE client: reads a controller's version and outputs, and sets its inputs.

Every wait has a deadline, and nothing in it needs ur-rtde: a watch of inputs next to the arm can
neither crash nor hang with that library.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Iterable, Sequence
from typing import Self

from drivers.rtde_wire import RTDE_PORT, PackageType, Packet, Recipe, Splitter, Value, WireError


class RtdeError(ConnectionError):
    """A controller answered no, or nothing, or something else than RTDE."""


class InUseError(RtdeError):
    """An input is claimed by another client.  Scenario: a fieldbus unit writes the same output."""


class RtdeClient:
    """A connection to a controller, closed at the end of a `with`.

    seconds  that connecting or an answer may take
    raises   OSError: nobody is there, or it does not answer in time (`RtdeError` is one)
    """

    def __init__(self, host: str, seconds: float = 2.0) -> None:
        self._seconds = seconds
        self._splitter = Splitter()
        self._waiting: list[Packet] = []
        self._output: Recipe | None = None
        self._inputs = 0
        self._socket = socket.create_connection((host, RTDE_PORT), seconds)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            if self._request(PackageType.PROTOCOL_VERSION, b"\x00\x02") != b"\x01":
                raise RtdeError("the controller does not speak version 2 of RTDE")
        except OSError:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the connection up; the controller frees the inputs that it had claimed."""
        self._socket.close()

    @property
    def address(self) -> str:
        """IP address of this computer, as the controller sees it."""
        address: str = self._socket.getsockname()[0]
        return address

    def controller_version(self) -> tuple[int, int, int, int]:
        """Major, minor, bugfix and build of the controller's software.  Raises OSError."""
        answer = self._request(PackageType.CONTROLLER_VERSION)
        try:
            major, minor, bugfix, build = struct.unpack(">4I", answer)
        except struct.error as error:
            raise RtdeError(f"the controller tells no version: {error}") from error
        return major, minor, bugfix, build

    def report(self, names: Sequence[str], rate_hz: float) -> None:
        """Let the controller report values; `start` begins.  Raises OSError."""
        request = struct.pack(">d", rate_hz) + ",".join(names).encode()
        answer = self._request(PackageType.OUTPUT_SETUP, request)
        self._output = _recipe(names, answer)

    def claim(self, names: Sequence[str]) -> Recipe:
        """Inputs of the controller that `write` may set together.

        raises  InUseError: another client has claimed one; RtdeError: there is none; OSError
        """
        return _recipe(names, self._request(PackageType.INPUT_SETUP, ",".join(names).encode()))

    def start(self) -> None:
        """Begin to report.  Raises OSError."""
        if self._request(PackageType.START) != b"\x01":
            raise RtdeError("the controller does not start to report")

    def pause(self) -> None:
        """Stop the reports; claims stay.  Raises OSError."""
        if self._request(PackageType.PAUSE) != b"\x01":
            raise RtdeError("the controller does not cease to report")
        self._waiting.clear()

    def newest(self, seconds: float) -> dict[str, Value]:
        """The values reported last, awaited for so long.  Raises OSError: nothing came in time."""
        due_s = time.monotonic() + seconds
        self._receive(0.0)
        while not any(p.kind == PackageType.DATA for p in self._waiting):
            remaining_s = due_s - time.monotonic()
            if remaining_s <= 0.0:
                raise RtdeError(f"the controller reports nothing for {seconds:.2f} s")
            self._receive(remaining_s)
        payload = [p.payload for p in self._waiting if p.kind == PackageType.DATA][-1]
        self._waiting.clear()
        assert self._output is not None, "report() comes first"
        return self._output.decoded(payload)

    def write(self, recipe: Recipe, values: Iterable[Value]) -> None:
        """Set claimed inputs.  Raises OSError."""
        self._send(Packet(PackageType.DATA, recipe.encoded(values)))

    # --- packets ------------------------------------------------------------------------------

    def _send(self, packet: Packet) -> None:
        self._socket.settimeout(self._seconds)
        self._socket.sendall(packet.encoded())

    def _request(self, kind: PackageType, payload: bytes = b"") -> bytes:
        """Payload of the answer, which is of the same kind."""
        self._send(Packet(kind, payload))
        due_s = time.monotonic() + self._seconds
        while True:
            for packet in self._waiting:
                if packet.kind == kind:
                    self._waiting.remove(packet)
                    return packet.payload
            remaining_s = due_s - time.monotonic()
            if remaining_s <= 0.0:
                raise RtdeError(f"no answer to {kind.name.lower()} within {self._seconds:.1f} s")
            self._receive(remaining_s)

    def _receive(self, seconds: float) -> None:
        """Process received packets, or the first one within a time."""
        self._socket.settimeout(seconds)
        with contextlib.suppress(BlockingIOError, TimeoutError):
            data = self._socket.recv(65536)
            if not data:
                raise RtdeError("the controller closed the connection")
            try:
                self._waiting += self._splitter.feed(data)
            except WireError as error:
                raise RtdeError(f"the controller sends no RTDE: {error}") from error


def _recipe(names: Sequence[str], answer: bytes) -> Recipe:
    """The recipe that an answer to a set-up allows: its number, then a type for each name."""
    types = tuple(answer[1:].decode("ascii", errors="replace").split(","))
    for name, kind in zip(names, types, strict=False):
        if kind == "IN_USE":
            raise InUseError(
                f"{name} is in use by another client; of fieldbus units and RTDE clients only one "
                "may write it"
            )
        if kind == "NOT_FOUND":
            raise RtdeError(f"this controller knows no {name}")
    if len(types) != len(names):
        raise RtdeError(f"the controller names {len(types)} types for {len(names)} values")
    return Recipe(answer[0], tuple(names), types)
