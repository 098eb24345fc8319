"""The handshake over Modbus/TCP: coils that the PLC writes, discrete inputs that it reads.

source  MODBUS Application Protocol Specification V1.1b3, 6.1, 6.2, 6.5, 6.11, 7; MODBUS Messaging
        on TCP/IP Implementation Guide V1.0b, 3.1.3
"""

from __future__ import annotations

import socket
import socketserver
import struct
import threading
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from typing import Self

from cell.plant.handshake.carrier import (
    UNKNOWN,
    CarrierError,
    Inputs,
    LatestBits,
    Outputs,
    bits_of,
    inputs_of,
)
from cell.settings.plant import Handshake, InputSignals, OutputSignals, signals_of
from drivers.threads import GuardedThread, error_text

#: Functions that are answered; all others have nothing behind them.
_READ_COILS, _READ_INPUTS, _WRITE_COIL, _WRITE_COILS = 1, 2, 5, 15
#: Codes of exceptions.
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3
_ON, _OFF = 0xFF00, 0
#: Most bits that one request may read, and write.
_MOST_READ, _MOST_WRITTEN = 2000, 1968
#: Transaction, protocol (0), bytes that follow, unit.
_HEADER = struct.Struct(">HHHB")
#: Longest request beyond transaction, protocol and length, bytes.
_LONGEST = 254
#: Bits are counted in words of so many.
_WORD = 16
_MOST_CLIENTS = 32
#: The server looks so often whether it is to end, and ends within this, s.
_LOOK_S, _END_S = 0.1, 5.0


class ModbusCarrier:
    """A Modbus/TCP server, within a `with`, in threads of its own.

    raises  CarrierError, from `with`: the address cannot be listened at
    """

    def __init__(self, said: Handshake) -> None:
        self._said = said
        self._heard = LatestBits(said.silence_s, f"the PLC writes nothing for {said.silence_s:g} s")
        self._lock = threading.Lock()
        self._coils: set[int] = set()
        self._wired = frozenset(at.number for _, at in signals_of(said.inputs))
        self._written: set[int] = set()
        self._written_s = float("-inf")
        self._told = bits_of(UNKNOWN, said.outputs)
        self._thread = GuardedThread("modbus", self._serve, self._died)

    def __enter__(self) -> Self:
        at = self._said.listen, self._said.port
        try:
            self._server = _Server(at, self._answered)
        except OSError as error:
            raise CarrierError(
                f"Modbus cannot listen at {at[0]}:{at[1]} ({error.strerror or error}); is the port "
                "free, and may this user listen at it?"
            ) from error
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(_END_S)

    def read(self) -> Inputs:
        """What the PLC says now.  Raises CarrierError: it wrote not all, or too long ago."""
        return inputs_of(self._heard.read(), self._said.inputs)

    def write(self, outputs: Outputs) -> None:
        """Tell the PLC at its next question."""
        self._told = bits_of(outputs, self._said.outputs)

    # --- the server's threads -----------------------------------------------------------------

    def _serve(self) -> None:
        self._server.serve_forever(_LOOK_S)

    def _died(self, error: BaseException) -> None:
        """A PLC that is away."""
        self._heard.lose(f"Modbus has ended: {error_text(error)}; start the handshake again")

    def _answered(self, asked: bytes) -> bytes:
        """The answer to a request, both from their function on."""
        function = asked[0]
        try:
            with self._lock:
                if function == _READ_COILS:
                    return _read(asked, self._coils, self._said.inputs)
                if function == _READ_INPUTS:
                    return _read(asked, self._told, self._said.outputs)
                if function in (_WRITE_COIL, _WRITE_COILS):
                    self._take(_written(asked, self._said.inputs))
                    return asked[:5]
        except _RefusedError as error:
            return bytes([function | 0x80, error.code])
        return bytes([function & 0x7F | 0x80, _ILLEGAL_FUNCTION])

    def _take(self, coils: Mapping[int, bool]) -> None:
        """Coils that are written; after a silence each of them has to be."""
        now_s = time.monotonic()
        if now_s - self._written_s > self._said.silence_s:
            self._written.clear()
        self._written_s = now_s
        self._written |= coils.keys()
        for number, value in coils.items():
            (self._coils.add if value else self._coils.discard)(number)
        if missing := self._wired - self._written:
            self._heard.lose(f"the PLC has not written coil {min(missing)} yet")
        else:
            self._heard.take(self._coils)


class _RefusedError(Exception):
    """A request gets an exception of the protocol.  Scenario: there is no coil of this number."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


def _read(asked: bytes, bits: Collection[int], places: InputSignals | OutputSignals) -> bytes:
    """The answer to a request for bits.  Raises _RefusedError."""
    first, count = _two_words(asked)
    _check(first, count, _MOST_READ, places)
    packed = sum(1 << at for at in range(count) if first + at in bits)
    size = -(-count // 8)
    return bytes([asked[0], size]) + packed.to_bytes(size, "little")


def _written(asked: bytes, places: InputSignals) -> dict[int, bool]:
    """What a request writes, by the number of the coil.  Raises _RefusedError."""
    if asked[0] == _WRITE_COIL:
        number, value = _two_words(asked)
        if value not in (_ON, _OFF):
            raise _RefusedError(_ILLEGAL_VALUE)
        _check(number, 1, 1, places)
        return {number: value == _ON}
    first, count = _two_words(asked[:5])
    size, packed = asked[5:6], asked[6:]
    if size != bytes([-(-count // 8) & 0xFF]) or len(packed) != size[0]:
        raise _RefusedError(_ILLEGAL_VALUE)
    _check(first, count, _MOST_WRITTEN, places)
    values = int.from_bytes(packed, "little")
    return {first + at: bool(values >> at & 1) for at in range(count)}


def _two_words(asked: bytes) -> tuple[int, int]:
    if len(asked) != 5:
        raise _RefusedError(_ILLEGAL_VALUE)
    first, second = struct.unpack(">HH", asked[1:])
    return int(first), int(second)


def _check(first: int, count: int, most: int, places: InputSignals | OutputSignals) -> None:
    """Raises _RefusedError: not so many bits at a time, or not there."""
    if not 0 < count <= most:
        raise _RefusedError(_ILLEGAL_VALUE)
    highest = max((at.number for _, at in signals_of(places)), default=0)
    if first + count > (highest // _WORD + 1) * _WORD:
        raise _RefusedError(_ILLEGAL_ADDRESS)


class _Server(socketserver.ThreadingTCPServer):
    """Listens from the beginning, and serves each client in a thread.  Raises OSError."""

    allow_reuse_address = daemon_threads = True
    block_on_close = False
    request_queue_size = _MOST_CLIENTS

    def __init__(self, at: tuple[str, int], answered: Callable[[bytes], bytes]) -> None:
        self.answered = answered
        self.clients: set[socket.socket] = set()
        self.address_family = socket.AF_INET6 if ":" in at[0] else socket.AF_INET
        super().__init__(at, _Client)

    def verify_request(self, request: object, client_address: object) -> bool:
        """Whether there is room for another client."""
        return len(self.clients) < _MOST_CLIENTS

    def handle_error(self, request: object, client_address: object) -> None:
        """A client has gone."""

    def server_close(self) -> None:
        """End every connection, too."""
        super().server_close()
        for client in tuple(self.clients):
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)


class _Client(socketserver.StreamRequestHandler):
    """Answers the requests of one client, one after another."""

    disable_nagle_algorithm = True
    server: _Server

    def handle(self) -> None:
        """Until it has gone, or says what is not Modbus."""
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.server.clients.add(self.request)
        try:
            while len(header := self.rfile.read(_HEADER.size)) == _HEADER.size:
                transaction, protocol, length, unit = _HEADER.unpack(header)
                if protocol != 0 or not 2 <= length <= _LONGEST:
                    return
                asked = self.rfile.read(length - 1)
                if len(asked) < length - 1:
                    return
                answer = self.server.answered(asked)
                self.wfile.write(_HEADER.pack(transaction, 0, len(answer) + 1, unit) + answer)
        finally:
            self.server.clients.discard(self.request)
