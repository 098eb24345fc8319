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

#: Supported function codes; all others are refused.
_READ_COILS, _READ_INPUTS, _WRITE_COIL, _WRITE_COILS = 1, 2, 5, 15
#: Exception codes.
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3
_ON, _OFF = 0xFF00, 0
#: Maximum number of bits that a request may read, and write.
_MOST_READ, _MOST_WRITTEN = 2000, 1968
#: Transaction, protocol (0), bytes that follow, unit.
_HEADER = struct.Struct(">HHHB")
#: Longest request after transaction, protocol and length, bytes.
_LONGEST = 254
#: Bits per word.
_WORD = 16
_MOST_CLIENTS = 32
#: Interval at which the server checks whether to end, and longest time that it takes to end, s.
_LOOK_S, _END_S = 0.1, 5.0


class ModbusCarrier:
    """A Modbus/TCP server, within a `with`, in threads of its own.

    raises  CarrierError, from `with`: the server cannot listen at the address
    """

    def __init__(self, settings: Handshake) -> None:
        self._settings = settings
        silence_s = settings.silence_s
        self._latest = LatestBits(silence_s, f"the PLC writes nothing for {silence_s:g} s")
        self._lock = threading.Lock()
        self._coils: set[int] = set()
        self._wired = frozenset(at.number for _, at in signals_of(settings.inputs))
        self._written: set[int] = set()
        self._written_s = float("-inf")
        self._outputs = bits_of(UNKNOWN, settings.outputs)
        self._thread = GuardedThread("modbus", self._serve, self._died)

    def __enter__(self) -> Self:
        at = self._settings.listen, self._settings.port
        try:
            self._server = _Server(at, self._response_to)
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
        """Newest inputs.  Raises CarrierError: some were never written, or all too long ago."""
        return inputs_of(self._latest.read(), self._settings.inputs)

    def write(self, outputs: Outputs) -> None:
        """Set the outputs, which the PLC reads by its next request."""
        self._outputs = bits_of(outputs, self._settings.outputs)

    # --- the server's threads -----------------------------------------------------------------

    def _serve(self) -> None:
        self._server.serve_forever(_LOOK_S)

    def _died(self, error: BaseException) -> None:
        """Treat the end of the server as a loss of the PLC."""
        self._latest.lose(f"Modbus has ended: {error_text(error)}; start the handshake again")

    def _response_to(self, request: bytes) -> bytes:
        """Response to a request, both from the function code on."""
        function = request[0]
        try:
            with self._lock:
                if function == _READ_COILS:
                    return _read(request, self._coils, self._settings.inputs)
                if function == _READ_INPUTS:
                    return _read(request, self._outputs, self._settings.outputs)
                if function in (_WRITE_COIL, _WRITE_COILS):
                    self._store_coils(_written_coils(request, self._settings.inputs))
                    return request[:5]
        except _RefusedError as error:
            return bytes([function | 0x80, error.code])
        return bytes([function & 0x7F | 0x80, _ILLEGAL_FUNCTION])

    def _store_coils(self, coils: Mapping[int, bool]) -> None:
        """Store written coils; after a silence each has to be written before they are valid."""
        now_s = time.monotonic()
        if now_s - self._written_s > self._settings.silence_s:
            self._written.clear()
        self._written_s = now_s
        self._written |= coils.keys()
        for number, value in coils.items():
            (self._coils.add if value else self._coils.discard)(number)
        if missing := self._wired - self._written:
            self._latest.lose(f"the PLC has not written coil {min(missing)} yet")
        else:
            self._latest.take(self._coils)


class _RefusedError(Exception):
    """A request is answered by a Modbus exception.  Scenario: no coil has this number."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


def _read(request: bytes, bits: Collection[int], places: InputSignals | OutputSignals) -> bytes:
    """Response to a request for bits.  Raises _RefusedError."""
    first, count = _two_words(request)
    _check(first, count, _MOST_READ, places)
    packed = sum(1 << at for at in range(count) if first + at in bits)
    size = -(-count // 8)
    return bytes([request[0], size]) + packed.to_bytes(size, "little")


def _written_coils(request: bytes, places: InputSignals) -> dict[int, bool]:
    """Values that a request writes, by coil number.  Raises _RefusedError."""
    if request[0] == _WRITE_COIL:
        number, value = _two_words(request)
        if value not in (_ON, _OFF):
            raise _RefusedError(_ILLEGAL_VALUE)
        _check(number, 1, 1, places)
        return {number: value == _ON}
    first, count = _two_words(request[:5])
    size, packed = request[5:6], request[6:]
    if size != bytes([-(-count // 8) & 0xFF]) or len(packed) != size[0]:
        raise _RefusedError(_ILLEGAL_VALUE)
    _check(first, count, _MOST_WRITTEN, places)
    values = int.from_bytes(packed, "little")
    return {first + at: bool(values >> at & 1) for at in range(count)}


def _two_words(request: bytes) -> tuple[int, int]:
    if len(request) != 5:
        raise _RefusedError(_ILLEGAL_VALUE)
    first, second = struct.unpack(">HH", request[1:])
    return int(first), int(second)


def _check(first: int, count: int, most: int, places: InputSignals | OutputSignals) -> None:
    """Raises _RefusedError: too many bits in a request, or an address out of range."""
    if not 0 < count <= most:
        raise _RefusedError(_ILLEGAL_VALUE)
    highest = max((at.number for _, at in signals_of(places)), default=0)
    if first + count > (highest // _WORD + 1) * _WORD:
        raise _RefusedError(_ILLEGAL_ADDRESS)


class _Server(socketserver.ThreadingTCPServer):
    """Listens once constructed, and serves each client in a thread.  Raises OSError."""

    allow_reuse_address = daemon_threads = True
    block_on_close = False
    request_queue_size = _MOST_CLIENTS

    def __init__(self, at: tuple[str, int], response_to: Callable[[bytes], bytes]) -> None:
        self.response_to = response_to
        self.clients: set[socket.socket] = set()
        self.address_family = socket.AF_INET6 if ":" in at[0] else socket.AF_INET
        super().__init__(at, _Client)

    def verify_request(self, request: object, client_address: object) -> bool:
        """Whether a further client is accepted."""
        return len(self.clients) < _MOST_CLIENTS

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore it: the client has disconnected."""

    def server_close(self) -> None:
        """Stop listening and end every connection."""
        super().server_close()
        for client in tuple(self.clients):
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)


class _Client(socketserver.StreamRequestHandler):
    """Answers the requests of one client, one after another."""

    disable_nagle_algorithm = True
    server: _Server

    def handle(self) -> None:
        """Serve until the client disconnects or sends no valid Modbus header."""
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.server.clients.add(self.request)
        try:
            while len(header := self.rfile.read(_HEADER.size)) == _HEADER.size:
                transaction, protocol, length, unit = _HEADER.unpack(header)
                if protocol != 0 or not 2 <= length <= _LONGEST:
                    return
                request = self.rfile.read(length - 1)
                if len(request) < length - 1:
                    return
                response = self.server.response_to(request)
                self.wfile.write(_HEADER.pack(transaction, 0, len(response) + 1, unit) + response)
        finally:
            self.server.clients.discard(self.request)
