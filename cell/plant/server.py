"""Unix socket server of a running cell for many programs, in one thread that never blocks."""

from __future__ import annotations

import fcntl
import logging
import os
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cell.plant.messages import PROTOCOL, CommandReply, Request, Status
from cell.plant.wire import (
    HEARTBEAT_S,
    LONGEST_LINE,
    LinkError,
    has_unix_sockets,
    line_of,
    read_line,
    request_of,
)
from drivers.threads import GuardedThread, only_logged

#: Notices that are kept for programs that come back.
MOST_NOTICES = 10_000
#: So much is taken from the journal at a time, bytes.
_CHUNK = 1 << 16
#: A program that does not read that many bytes of answers is disconnected.
_MOST_UNREAD = 1 << 20


class LaggingError(Exception):
    """A program does not read its notices.  Scenario: it was halted for 10,000 notices."""


class Journal:
    """The newest notices of a run, as lines, without gaps in their sequence."""

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
    """Connection to a program.  No method blocks.

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


_LOG = logging.getLogger(__name__)

#: Further programs are refused.
MOST_CLIENTS = 200
#: So long the end waits for the thread, s.
_CLOSE_S = 2.0
#: After a program that could not be let in the next is so late, s.
_NO_FILES_S = 0.1


class CommandServer:
    """Serves the connected programs within a `with`.

    path     of the socket; only this user may connect
    run      of the cell, for the greeting
    journal  notices, in their order; only added to before `wake`
    status   state of the cell now
    ask      hands on a request; its second argument is called with the answer, in any thread

    raises  LinkError, from `with`: another cell runs there, or there can be no socket
    """

    def __init__(
        self,
        path: Path,
        run: str,
        journal: Journal,
        status: Callable[[], Status],
        ask: Callable[[Request, Callable[[CommandReply], None]], None],
    ) -> None:
        self._path = path
        self._greeting = line_of("greeting", {"protocol": PROTOCOL, "run": run})
        self._journal = journal
        self._status = status
        self._ask = ask
        self._answers: deque[tuple[CellConnection, CommandReply]] = deque()
        self._connections: set[CellConnection] = set()
        self._opened = ExitStack()
        self._over = False

    def wake(self) -> None:
        """There is something to send; from any thread."""
        with suppress(OSError):  # it is full: the thread wakes anyway; or closed
            self._waking.send(b".")

    def __enter__(self) -> CommandServer:
        with ExitStack() as stack:
            self._listening = _listening_at(self._path, stack)
            self._selector = stack.enter_context(selectors.DefaultSelector())
            self._woken, self._waking = socket.socketpair()
            for end in (self._woken, self._waking):
                stack.enter_context(end).setblocking(False)
            self._selector.register(self._listening, selectors.EVENT_READ)
            self._selector.register(self._woken, selectors.EVENT_READ)
            thread = GuardedThread("link socket", self._serve, only_logged)
            thread.start()
            stack.callback(thread.join, _CLOSE_S)
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.abandon()
        self._opened.close()

    def abandon(self) -> None:
        """Disconnect all programs, and let none in: what they see of the cell would be old."""
        self._over = True
        self.wake()

    def _serve(self) -> None:
        try:
            self._serve_all()
        finally:
            self._listening.close()
            for connection in tuple(self._connections):
                self._drop(connection)

    def _serve_all(self) -> None:
        while not self._over:
            for key, events in self._selector.select(self._until_heartbeat_s()):
                if key.fileobj is self._listening:
                    self._accept()
                elif key.fileobj is self._woken:
                    self._woken.recv(4096)
                elif events & selectors.EVENT_READ:
                    self._receive(key.data)
            while self._answers:
                connection, answer = self._answers.popleft()
                self._put(connection, "answer", asdict(answer))
            now_s = time.monotonic()
            for connection in tuple(self._connections):
                if connection.alive_due_s() <= now_s:
                    self._put(connection, "alive", None)
                self._send(connection)
        for connection in tuple(self._connections):
            self._send(connection)  # what its program can still read

    def _until_heartbeat_s(self) -> float | None:
        """So long it may sleep; None = until something happens."""
        due_s = min((c.alive_due_s() for c in self._connections), default=float("inf"))
        return None if due_s == float("inf") else max(0.0, due_s - time.monotonic())

    def _accept(self) -> None:
        try:
            connected, _ = self._listening.accept()
        except BlockingIOError:  # it has gone again
            return
        except OSError as error:  # as many files are open as may be
            _LOG.warning("a program could not connect: %s", error)
            time.sleep(_NO_FILES_S)
            return
        connection = CellConnection(connected)
        self._connections.add(connection)
        self._selector.register(connected, selectors.EVENT_READ, connection)
        if len(self._connections) > MOST_CLIENTS:
            self._refuse(connection, f"{MOST_CLIENTS} programs are connected already")
            return
        connection.put(self._greeting)

    def _receive(self, connection: CellConnection) -> None:
        try:
            for kind, data in connection.read():
                if connection in self._connections:
                    self._answer(connection, kind, data)
        except ValueError as error:
            self._refuse(connection, str(error))
        except OSError:
            self._drop(connection)

    def _answer(self, connection: CellConnection, kind: str, data: Any) -> None:
        """Do what a program asks.  Raises ValueError: it is nothing that can be asked."""
        if not connection.greeted:
            if kind != "greeting" or not isinstance(data, dict):
                raise ValueError("the first message is no greeting")
            if data.get("protocol") != PROTOCOL:
                spoken = f"this cell speaks protocol {PROTOCOL}, not {data.get('protocol')!r}"
                raise ValueError(f"{spoken}; update the older of the two programs")
            connection.greeted = True
        elif kind == "status":
            self._put(connection, "status", asdict(self._status()))
        elif kind == "follow":
            self._follow(connection, data)
        elif kind == "request":
            try:
                request = request_of(data)
            except ValueError as error:
                refused = CommandReply(False, self._status().state, str(error))
                self._put(connection, "answer", asdict(refused))
            else:
                self._ask(request, lambda answer: self._answered(connection, answer))
        else:
            raise ValueError(f"{kind!r} is no message to a cell")

    def _follow(self, connection: CellConnection, data: Any) -> None:
        """Tell it all notices from now on, or from where it was."""
        status = self._status()
        match data:
            case {"run": status.run, "sequence": int(sequence)} if self._journal.has_all_after(
                sequence
            ):
                self._put(connection, "alive", None)  # at once: it may have nothing else to say
                connection.told = sequence
            case _:
                self._put(connection, "status", asdict(status))
                connection.told = status.sequence

    def _answered(self, connection: CellConnection, answer: CommandReply) -> None:
        self._answers.append((connection, answer))
        self.wake()

    def _put(self, connection: CellConnection, kind: str, data: Any) -> None:
        try:
            connection.put(line_of(kind, data))
        except LaggingError:
            self._drop(connection)

    def _send(self, connection: CellConnection) -> None:
        try:
            connection.write(self._journal)
        except LaggingError:
            _LOG.warning("a program that does not read is disconnected")
            self._drop(connection)
        except OSError:
            self._drop(connection)
        else:
            both = selectors.EVENT_READ | selectors.EVENT_WRITE
            events = both if connection.waits else selectors.EVENT_READ
            if self._selector.get_key(connection.socket).events != events:
                self._selector.modify(connection.socket, events, connection)

    def _refuse(self, connection: CellConnection, reason: str) -> None:
        """Disconnect it, and say why."""
        self._put(connection, "refused", reason)
        self._send(connection)
        self._drop(connection)

    def _drop(self, connection: CellConnection) -> None:
        if connection in self._connections:
            self._connections.remove(connection)
            self._selector.unregister(connection.socket)
            connection.close()


def _listening_at(path: Path, stack: ExitStack) -> socket.socket:
    """A socket for this user only; that of a cell which is no more is replaced.

    stack   closes and removes it
    raises  LinkError: another cell runs there, or there can be none
    """
    if not has_unix_sockets():
        raise LinkError("this system has no Unix sockets: no program can reach this cell")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _lock(path.with_name(f"{path.name}.lock"), stack)
        path.unlink(missing_ok=True)
        listening = stack.enter_context(socket.socket(socket.AF_UNIX))
        listening.setblocking(False)
        listening.bind(str(path))
        stack.callback(path.unlink, missing_ok=True)
        path.chmod(0o600)  # nobody can connect before it listens
        listening.listen(MOST_CLIENTS)
    except BlockingIOError as error:
        raise LinkError(f"another cell runs there already: it has {path}") from error
    except OSError as error:
        cause = error.strerror or str(error)
        raise LinkError(f"no program can reach this cell: {path}: {cause}") from error
    return listening


def _lock(path: Path, stack: ExitStack) -> None:
    """Hold a file as long as this process lives; it goes at the end.

    raises  BlockingIOError: another cell holds it
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(descriptor).st_ino == path.stat().st_ino:
                break
        except FileNotFoundError:  # who held it has just removed it
            os.close(descriptor)
        except OSError:
            os.close(descriptor)
            raise
        else:
            os.close(descriptor)
    stack.callback(os.close, descriptor)
    stack.callback(path.unlink, missing_ok=True)
