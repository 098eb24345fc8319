"""The server of Robotiq's URCap on a UR controller, with the gripper behind it and faults.

source  Robotiq, "2F-85 & 2F-140 Instruction Manual for e-Series Universal Robots"
"""

from __future__ import annotations

import os
import select
import socket
import time
from typing import Self

from drivers.emulators.robotiq import Jaws
from drivers.threads import GuardedThread, only_logged

#: Register, first bit and bits of the writable variables, and of the readable ones.
_WRITTEN = {
    "ACT": (0x3E8, 8, 1),
    "GTO": (0x3E8, 11, 1),
    "ATR": (0x3E8, 12, 1),
    "POS": (0x3E9, 0, 8),
    "SPE": (0x3EA, 8, 8),
    "FOR": (0x3EA, 0, 8),
}
_READ = _WRITTEN | {
    "STA": (0x7D0, 12, 2),
    "OBJ": (0x7D0, 14, 2),
    "FLT": (0x7D1, 8, 8),
    "PRE": (0x7D1, 0, 8),
    "POS": (0x7D2, 8, 8),
}


def respond(jaws: Jaws, line: str, plugged: bool) -> str:
    """Answer of the URCap's server to a line."""
    match line.split():
        case ["GET", name] if name in _READ:
            register, first, bits = _READ[name]
            value = jaws.read(register) >> first & (1 << bits) - 1
            return f"{name} {value}" if plugged else f"{name} ?"
        case ["SET", *words] if words and len(words) % 2 == 0 and set(words[::2]) <= set(_WRITTEN):
            for name, value in zip(words[::2], map(int, words[1::2]), strict=True):
                register, first, bits = _WRITTEN[name]
                others = jaws.read(register) & ~((1 << bits) - 1 << first)
                if plugged:
                    jaws.write(register, [others | value << first])
            return "ack"
    return "nack"


class EmulatedUrcap:
    """The server at `host` and `port`, served by a thread within a `with`.

    jaws  the gripper on the tool flange
    port  0 = any that is free
    """

    def __init__(self, jaws: Jaws, host: str = "127.0.0.1", port: int = 0) -> None:
        self.jaws = jaws
        self.plugged = True
        self._listener = socket.create_server((host, port))
        self.host, self.port = self._listener.getsockname()[:2]
        self._clients: list[socket.socket] = []
        self._wake, self._waker = os.pipe()
        self._thread = GuardedThread("urcap", self._serve, only_logged)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._waker, b"!")
        self._thread.join()
        for one in (self._listener, *self._clients):
            one.close()
        os.close(self._wake)
        os.close(self._waker)

    def unplug(self) -> None:
        """Pull the gripper off the tool flange, which is also its power: activation goes."""
        self.plugged = False
        self.jaws.write(0x3E8, [0])

    def _serve(self) -> None:
        before_s = time.monotonic()
        while True:
            awaited: list[socket.socket | int] = [self._wake, self._listener, *self._clients]
            ready, _, _ = select.select(awaited, [], [], 0.01)
            now_s = time.monotonic()
            self.jaws.advance(now_s - before_s)
            before_s = now_s
            if self._wake in ready:
                return
            if self._listener in ready:
                self._clients.append(self._listener.accept()[0])
            for client in [c for c in self._clients if c in ready]:
                self._hear(client)

    def _hear(self, client: socket.socket) -> None:
        try:
            lines = client.recv(1024).decode().splitlines()
            faults = self.jaws.faults
            for line in lines if not faults.silent else []:
                answer = respond(self.jaws, line, self.plugged).encode()
                client.sendall(os.urandom(len(answer)) if faults.garbage else answer)
        except OSError:
            lines = []
        if not lines:
            self._clients.remove(client)
            client.close()
