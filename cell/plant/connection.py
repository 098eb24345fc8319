"""One program that is connected to the cell: what it has said, and what it is still to be told."""

from __future__ import annotations

import socket
import time
from typing import Any

from cell.plant.wire import HEARTBEAT_S, LONGEST_LINE, read_line

#: Notices that are kept for programs that come back.
MOST_NOTICES = 10_000
#: So much is taken from the journal at a time, bytes.
_CHUNK = 1 << 16
#: A program that does not read that many bytes of answers is disconnected.
_MOST_UNREAD = 1 << 20


class LaggingError(Exception):
    """A program does not read.  Scenario: it was halted, and 10,000 notices have come since."""


class Journal:
    """The newest notices of a run, as lines; their sequence has no gap."""

    def __init__(self) -> None:
        self._lines: dict[int, bytes] = {}
        self.newest = 0

    def add(self, line: bytes) -> None:
        """Append the next notice; the oldest goes."""
        self._lines[self.newest + 1] = line
        self.newest += 1  # now it may be looked for, by another thread
        self._lines.pop(self.newest - MOST_NOTICES, None)

    def has_all_after(self, sequence: int) -> bool:
        """Whether it has every notice that came after this one."""
        return self.newest - len(self._lines) <= sequence <= self.newest

    def after(self, sequence: int) -> bytes:
        """The line after one that is not the newest.  Raises KeyError: it has gone."""
        return self._lines[sequence + 1]


class CellConnection:
    """A connected program.  Nothing here waits.

    greeted  whether it has said which version it speaks
    told     sequence of the newest notice that it got or is about to get; None = it does not follow
    """

    def __init__(self, connected: socket.socket) -> None:
        self.socket = connected
        self.socket.setblocking(False)
        self.greeted = False
        self.told: int | None = None
        self.waits = False
        self._sent_s = time.monotonic()
        self._heard = b""
        self._unsent = bytearray()

    def close(self) -> None:
        """Disconnect."""
        self.socket.close()

    def read(self) -> list[tuple[str, Any]]:
        """What it has said by now.

        raises  ConnectionError: it has gone; ValueError: it does not speak this protocol
        """
        try:
            new = self.socket.recv(_CHUNK)
        except BlockingIOError:
            return []
        if not new:
            raise ConnectionResetError
        *lines, self._heard = (self._heard + new).split(b"\n")
        if len(self._heard) > LONGEST_LINE:
            raise ValueError(f"a line is longer than {LONGEST_LINE} bytes")
        return [read_line(line) for line in lines]

    def put(self, line: bytes) -> None:
        """Tell it something.  Raises LaggingError: it does not read."""
        if len(self._unsent) > _MOST_UNREAD:
            raise LaggingError
        self._unsent += line

    def alive_due_s(self) -> float:
        """When it is to be told that the cell is alive, on the monotonic clock; inf = never."""
        if self.told is None or self.waits:
            return float("inf")
        return self._sent_s + HEARTBEAT_S

    def write(self, journal: Journal) -> None:
        """Send what it takes now; `waits` = there is more.

        raises  LaggingError: what comes next has left the journal; OSError: it has gone
        """
        self.waits = False
        while True:
            self._fill(journal)
            if not self._unsent:
                return
            try:
                sent = self.socket.send(self._unsent)
            except BlockingIOError:
                self.waits = True
                return
            del self._unsent[:sent]
            self._sent_s = time.monotonic()

    def _fill(self, journal: Journal) -> None:
        while self.told is not None and self.told < journal.newest and len(self._unsent) < _CHUNK:
            try:
                self._unsent += journal.after(self.told)
            except KeyError as error:
                raise LaggingError from error
            self.told += 1
