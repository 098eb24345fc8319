"""Unix socket server of a running cell for many programs, in one thread."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import socket
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
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

#: Notices stored for programs that reconnect.
MOST_NOTICES = 10_000
#: Largest part of the journal that is sent at a time, bytes.
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


@dataclass(eq=False)
class _Program:
    """A connected program.

    greeted  whether it has sent its protocol version
    sent     sequence of the newest notice sent to it, or being sent; None = it does not follow
    news     set when there is something to send
    """

    writer: asyncio.StreamWriter
    greeted: bool = False
    sent: int | None = None
    news: asyncio.Event = field(default_factory=asyncio.Event)
    following: asyncio.Task[None] | None = None

    def put(self, kind: str, data: Any) -> None:
        """Send a message; a program that does not read is disconnected."""
        if self.writer.transport.get_write_buffer_size() > _MOST_UNREAD:
            self.writer.transport.abort()
        else:
            self.writer.write(line_of(kind, data))


_LOG = logging.getLogger(__name__)

#: Further programs are refused.
MOST_CLIENTS = 200
#: So long the end waits for the thread, s.
_CLOSE_S = 2.0


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
        self._run = run
        self._journal = journal
        self._status = status
        self._ask = ask
        self._programs: set[_Program] = set()
        self._opened = ExitStack()
        self._over = asyncio.Event()

    def wake(self) -> None:
        """There is something to send; from any thread."""
        self._call(self._ring)

    def abandon(self) -> None:
        """Disconnect all programs, and let none in: their view of the cell would be outdated."""
        self._call(self._over.set)

    def _call(self, callback: Callable[..., None], *arguments: Any) -> None:
        """Let the server's thread call a function; from any thread."""
        with suppress(RuntimeError):  # it has ended
            self._loop.call_soon_threadsafe(callback, *arguments)

    def __enter__(self) -> CommandServer:
        with ExitStack() as stack:
            self._listening = _listening_at(self._path, stack)
            self._loop = asyncio.new_event_loop()
            thread = GuardedThread("link socket", self._serve, only_logged)
            thread.start()
            stack.callback(thread.join, _CLOSE_S)
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.abandon()
        self._opened.close()

    # --- the thread ---------------------------------------------------------------------------

    def _serve(self) -> None:
        try:
            self._loop.run_until_complete(self._serve_all())
        finally:
            self._listening.close()
            self._loop.close()

    async def _serve_all(self) -> None:
        server = await asyncio.start_unix_server(
            self._connected, sock=self._listening, limit=LONGEST_LINE, backlog=MOST_CLIENTS
        )
        await self._over.wait()
        # Nobody is let in any more.  To close the server now would leave open whom it has just let
        # in: asyncio forgets such a connection without closing it.
        self._loop.remove_reader(self._listening)
        for program in tuple(self._programs):
            with suppress(LaggingError):
                while self._send_news(program):  # all that it can still read
                    pass
            program.writer.transport.abort()
        while tasks := asyncio.all_tasks() - {asyncio.current_task()}:  # one may begin another
            await asyncio.gather(*tasks, return_exceptions=True)
        server.close()

    def _ring(self) -> None:
        for program in self._programs:
            program.news.set()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer a program until it has gone."""
        program = _Program(writer)
        self._programs.add(program)
        try:
            if self._over.is_set():
                raise ConnectionAbortedError
            if len(self._programs) > MOST_CLIENTS:
                raise ValueError(f"{MOST_CLIENTS} programs are connected already")
            program.put("greeting", {"protocol": PROTOCOL, "run": self._run})
            while (line := await _line_from(reader)).endswith(b"\n"):
                self._answer(program, *read_line(line))
        except ValueError as error:
            program.put("refused", str(error))
        except OSError:  # it has gone
            pass
        finally:
            self._programs.discard(program)
            if program.following is not None:
                program.following.cancel()
            writer.transport.abort()  # unread data must not keep the connection open
            with suppress(OSError):
                await writer.wait_closed()

    def _answer(self, program: _Program, kind: str, data: Any) -> None:
        """Serve a message of a program.  Raises ValueError: it is no valid message."""
        if not program.greeted:
            if kind != "greeting" or not isinstance(data, dict):
                raise ValueError("the first message is no greeting")
            if data.get("protocol") != PROTOCOL:
                spoken = f"this cell speaks protocol {PROTOCOL}, not {data.get('protocol')!r}"
                raise ValueError(f"{spoken}; update the older of the two programs")
            program.greeted = True
        elif kind == "status":
            program.put("status", asdict(self._status()))
        elif kind == "follow":
            self._begin_to_follow(program, data)
        elif kind == "request":
            try:
                request = request_of(data)
            except ValueError as error:
                refused = CommandReply(False, self._status().state, str(error))
                program.put("answer", asdict(refused))
            else:
                self._ask(request, lambda answer: self._call(program.put, "answer", asdict(answer)))
        else:
            raise ValueError(f"{kind!r} is no message to a cell")

    def _begin_to_follow(self, program: _Program, data: Any) -> None:
        """Send it all notices from now on, or from where it was."""
        status = self._status()
        match data:
            case {"run": status.run, "sequence": int(sequence)} if self._journal.has_all_after(
                sequence
            ):
                program.put("alive", None)  # at once: it may have nothing else to say
                program.sent = sequence
            case _:
                program.put("status", asdict(status))
                program.sent = status.sequence
        if program.following is None:
            program.following = asyncio.create_task(self._follow(program))

    async def _follow(self, program: _Program) -> None:
        """Send every notice, and signs of life, until the program disconnects."""
        try:
            while True:
                program.news.clear()
                while self._send_news(program):
                    await program.writer.drain()
                try:
                    async with asyncio.timeout(HEARTBEAT_S):
                        await program.news.wait()
                except TimeoutError:
                    program.put("alive", None)
        except LaggingError:
            _LOG.warning("a program that does not read is disconnected")
        except OSError:  # it has gone
            pass
        except Exception:  # better disconnected than connected without notices
            _LOG.exception("a program is told nothing more")
        finally:
            program.writer.close()

    def _send_news(self, program: _Program) -> bool:
        """Send notices that it has not got, a chunk at most; whether there were any.

        raises  LaggingError: the next notice is not in the journal any more
        """
        lines: list[bytes] = []
        size = 0
        while program.sent is not None and program.sent < self._journal.newest and size < _CHUNK:
            try:
                lines.append(self._journal.after(program.sent))
            except KeyError as error:
                raise LaggingError from error
            program.sent += 1
            size += len(lines[-1])
        program.writer.writelines(lines)
        return bool(lines)


async def _line_from(reader: asyncio.StreamReader) -> bytes:
    """The next line, or the rest before the end.  Raises ValueError: it is too long."""
    try:
        return await reader.readline()
    except ValueError as error:
        raise ValueError(f"a line is longer than {LONGEST_LINE} bytes") from error


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
