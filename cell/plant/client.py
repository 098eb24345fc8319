"""Client of a running cell: a program that observes it, follows its notices and commands it."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cell.plant.messages import PROTOCOL, CommandReply, Notice, Request, Status
from cell.plant.wire import (
    LONGEST_LINE,
    SILENCE_S,
    LinkError,
    NoCellError,
    ProtocolError,
    has_unix_sockets,
    line_of,
    message_of,
    read_line,
    socket_of,
)

#: A cell that is away is looked for again so soon, s, then later and later.
_FIRST_S, _LAST_S = 0.1, 1.0


class Client:
    """Client of the cell whose records are in `runs`; safe to be used from many threads.

    Every request has a connection of its own, so a cell may end and begin between two.

    timeout_s  longest wait for an answer
    away       why the followed cell is not reached; None = it is
    heard_s    time of its last message, on the monotonic clock
    on_lost    called, in the thread that follows, when a followed cell is lost or silent
    on_there   called there when it is reached again without a new message; otherwise that message
               shows it
    """

    def __init__(
        self,
        runs: Path,
        *,
        timeout_s: float = 5.0,
        on_lost: Callable[[], None] = lambda: None,
        on_there: Callable[[], None] = lambda: None,
    ) -> None:
        self.path = socket_of(runs)
        self._runs = runs
        self._timeout_s = timeout_s
        self._on_lost = on_lost
        self._on_there = on_there
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self.away: LinkError | None = None
        self.heard_s = 0.0

    def connect(self, wait_s: float = 0.0) -> Client:
        """Make sure that a cell is there; returns this client.

        wait_s  longest wait for a cell
        raises  NoCellError: none is; ProtocolError: it speaks another version; LinkError
        """
        until_s = time.monotonic() + wait_s
        while True:
            try:
                with self._conversation():
                    return self
            except NoCellError:
                if time.monotonic() >= until_s or self._closed.wait(_FIRST_S):
                    raise

    def status(self) -> Status:
        """State of the cell now.  Raises NoCellError; ProtocolError; LinkError."""
        with self._conversation() as talk:
            return message_of(Status, talk.ask("status", None, "status"))

    def send(self, request: Request) -> CommandReply:
        """Send a request, once.

        raises  NoCellError: no cell runs; LinkError: the fate of the request is not known, but a
                cell refuses one that is older than `OLDEST_S`
        """
        with self._conversation() as talk:
            return message_of(CommandReply, talk.ask("request", asdict(request), "answer"))

    def follow(self, after: tuple[str, int] | None = None) -> Iterator[Notice | Status]:
        """All notices, in order, until `close`; after a cell has ended, those of the next.

        Notices without a gap to the last ones come alone.  Otherwise a Status comes first: at the
        beginning, of a new run, or after too long a time.

        after   run and sequence of the last known notice; None = none
        raises  ProtocolError: cell and program are of different versions
        """
        pause_s, there = _FIRST_S, False
        while not self._closed.is_set():
            try:
                for message in self._messages(after):
                    before, there, pause_s = there, True, _FIRST_S
                    self.away, self.heard_s = None, time.monotonic()
                    if message is not None:
                        after = message.run, message.sequence
                        yield message
                    elif not before:
                        self._on_there()
            except ProtocolError:
                raise
            except LinkError as error:
                self.away = error
                if there:
                    there = False
                    self._on_lost()
            self._closed.wait(pause_s)
            pause_s = min(2.0 * pause_s, _LAST_S)

    def _messages(self, after: tuple[str, int] | None) -> Iterator[Notice | Status | None]:
        """All that happens as long as one connection lasts; None is a sign of life.

        raises  LinkError: it has ended, or the cell is silent
        """
        with self._conversation() as talk:
            run, sequence = after or (None, None)
            talk.send("follow", {"run": run, "sequence": sequence})
            while True:
                yield talk.receive()

    def close(self) -> None:
        """End everything that is under way, from any thread; a client is closed for good."""
        self._closed.set()
        with self._lock:
            for connected in self._open:
                with suppress(OSError):
                    connected.shutdown(socket.SHUT_RDWR)

    @contextmanager
    def _conversation(self) -> Iterator[_Conversation]:
        if not has_unix_sockets():
            raise LinkError("this system has no Unix sockets: no cell can be reached")
        with socket.socket(socket.AF_UNIX) as connected:
            connected.settimeout(self._timeout_s)
            with self._lock:
                if self._closed.is_set():
                    raise LinkError("this client is closed")
                self._open.add(connected)
            try:
                try:
                    connected.connect(str(self.path))
                except (FileNotFoundError, ConnectionRefusedError) as error:
                    raise NoCellError(f"no cell runs with the records {self._runs}") from error
                talk = _Conversation(connected)
                talk.begin()
                yield talk
            except LinkError:
                raise
            except TimeoutError as error:
                waited_s = connected.gettimeout() or 0.0
                raise LinkError(
                    f"the cell says nothing for {waited_s:g} s: it is halted, or this computer has "
                    f"too much to do: {self.path}"
                ) from error
            except OSError as error:
                cause = error.strerror or str(error) or type(error).__name__
                raise LinkError(f"the cell is lost: {cause}: {self.path}") from error
            finally:
                with self._lock:
                    self._open.discard(connected)


class _Conversation:
    """One connection, line by line.  Raises LinkError and OSError, from every method."""

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        self._heard = bytearray()

    def begin(self) -> None:
        """Greet each other."""
        self.send("greeting", {"protocol": PROTOCOL})
        spoken = self._expect("greeting").get("protocol")
        if spoken != PROTOCOL:
            raise ProtocolError(
                f"the cell speaks protocol {spoken!r}, this program {PROTOCOL}; update the older"
            )

    def ask(self, kind: str, data: Any, wanted: str) -> Any:
        """Say something; the answer, of the kind that is wanted."""
        self.send(kind, data)
        return self._expect(wanted)

    def send(self, kind: str, data: Any) -> None:
        """Send a line."""
        self._socket.sendall(line_of(kind, data))

    def receive(self) -> Notice | Status | None:
        """The next notice, the status that comes first, or a sign of life; waits for it."""
        self._socket.settimeout(SILENCE_S)
        kind, data = self._line()
        match kind:
            case "notice":
                return message_of(Notice, data)
            case "status":
                return message_of(Status, data)
            case "alive":
                return None
        raise LinkError(f"{kind}: {data}")

    def _expect(self, wanted: str) -> Any:
        kind, data = self._line()
        if kind == "refused":
            raise (ProtocolError if "protocol" in data else LinkError)(f"refused: {data}")
        if kind != wanted:
            raise ProtocolError(f"the cell says {kind!r} instead of {wanted!r}")
        return data

    def _line(self) -> tuple[str, Any]:
        while (end := self._heard.find(b"\n")) < 0:
            if len(self._heard) > 4 * LONGEST_LINE:
                raise ProtocolError("the cell does not speak this protocol: a line has no end")
            new = self._socket.recv(1 << 16)
            if not new:
                raise LinkError("the cell has ended")
            self._heard += new
        line = bytes(self._heard[:end])
        del self._heard[: end + 1]
        try:
            return read_line(line)
        except ValueError as error:
            raise ProtocolError(f"the cell does not speak this protocol: {error}") from error
