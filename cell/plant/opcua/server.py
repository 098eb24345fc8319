"""The server: a process beside the cell that follows it and shows it to clients of OPC UA."""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from enum import Enum
from functools import partial
from importlib.metadata import version
from pathlib import Path

from asyncua import ua

from cell.plant.client import Client
from cell.plant.messages import MessageKind, Notice, Status
from cell.plant.opcua import packml
from cell.plant.opcua.access import GuardedServer
from cell.plant.opcua.arrival import TimedServer
from cell.plant.opcua.certificates import own_certificate
from cell.plant.opcua.commands import Methods
from cell.plant.opcua.events import Transitions
from cell.plant.opcua.space import AddressSpace
from cell.plant.opcua.types import add_types
from cell.plant.opcua.unit import Unit, tags_of
from cell.plant.opcua.view import PackmlView
from cell.plant.users import FILE as USERS
from cell.plant.users import all_users
from cell.plant.wire import ProtocolError
from cell.settings import Settings
from cell.settings.plant import OpcUa
from cell.settings.referred import line_of
from drivers.threads import GuardedThread

_LOG = logging.getLogger(__name__)

#: Namespace of what PackML has no name for.
OWN_URI = "urn:cable-cell:opcua"
#: Times are shown anew so often, s.
_TICK_S = 1.0
#: After the cell has spoken another version it is asked again so much later, s.
_AGAIN_S = 5.0


class _CellReturned(Enum):
    """A cell that was lost is there again, as it was."""

    AGAIN = "again"


#: What the thread that follows hands over; None = the cell was lost.
_Heard = Notice | Status | _CellReturned | None

_PLAIN = ua.SecurityPolicyType.NoSecurity
_ENCRYPTED = [
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
]


def serve(
    settings: Settings, runs: Path, ready: Callable[[str], None] = print, users: Path = USERS
) -> None:
    """Serve until SIGTERM or Ctrl-C.

    runs    folder of the cell's records
    ready   told the address once clients may come
    users   file of the users
    raises  ValueError: no section `plant.opcua`, the address cannot be listened at, or the folder
            cannot be written; the message says what to do
    """
    asyncio.run(_until_stopped(settings, runs, ready, users))


async def _until_stopped(
    settings: Settings, runs: Path, ready: Callable[[str], None], users: Path
) -> None:
    stopped, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopped.set)
    async with running(settings, runs, users) as address:
        ready(address)
        await stopped.wait()


@asynccontextmanager
async def running(settings: Settings, runs: Path, users: Path = USERS) -> AsyncIterator[str]:
    """The server, as long as the `with` lasts; gives its address.  Raises ValueError as `serve`."""
    opcua = None if settings.plant is None else settings.plant.opcua
    if opcua is None:
        raise ValueError("the settings have no section plant.opcua; add one, it may be empty: {}")
    ideal_s = None if settings.ledger is None else settings.ledger.ideal_cycle_s
    tags = tags_of(line_of(settings), None if ideal_s is None else 60.0 / ideal_s)
    _forward_messages()
    try:
        server = await _made(opcua, users)
    except OSError as error:
        raise ValueError(
            f"{error.filename or opcua.folder}: {error.strerror or error}; name another folder in "
            "plant.opcua.folder, or make it writable"
        ) from error
    own, standard = [await server.register_namespace(u) for u in (OWN_URI, packml.URI)]
    space = AddressSpace(server, standard, own)
    add_types(space)
    unit = Unit(space, opcua.name, tags)
    shown = _Shown(unit, await Transitions.at(space, unit))
    client = Client(runs, on_lost=shown.lost, on_there=shown.found)
    Methods(space, unit, client.send, lambda: shown.view, shown.refused)
    await _listen(server, opcua)
    loop, owner = asyncio.get_running_loop(), asyncio.current_task()
    assert owner is not None

    def ended(error: BaseException) -> None:
        loop.call_soon_threadsafe(owner.cancel)  # clients would read old values as if they were new

    following = GuardedThread("follow", partial(shown.follow, client), ended)
    showing = asyncio.create_task(shown.show())
    showing.add_done_callback(lambda task: _failed(task) and owner.cancel())
    following.start()
    try:
        yield server.endpoint.geturl()
    finally:
        shown.closed = True
        client.close()
        showing.cancel()
        await asyncio.to_thread(following.join, 10.0)
        await server.stop()
        with suppress(asyncio.CancelledError):
            await showing


def _failed(task: asyncio.Task[None]) -> bool:
    return not task.cancelled() and task.exception() is not None


async def _made(opcua: OpcUa, users: Path) -> TimedServer:
    """A server that does not listen yet.  Raises OSError: its files cannot be written."""
    accounts = all_users(users, opcua.folder)
    server = TimedServer(iserver=GuardedServer(accounts, opcua.folder, opcua.is_loopback))
    await server.init()
    uri = f"urn:{socket.gethostname()}:cable-cell:{opcua.name}"
    await server.set_application_uri(uri)
    server.set_server_name(f"Cable cell {opcua.name}")
    server.application_type = ua.ApplicationType.Server
    await server.set_build_info(
        "urn:cable-cell", "cable-cell", "Cable cell", version("cable-cell"), "", datetime.now(UTC)
    )
    certificate, key = own_certificate(opcua.folder, uri, opcua.listen)
    await server.load_certificate(str(certificate))
    await server.load_private_key(str(key))
    server.set_security_policy([*([_PLAIN] if opcua.is_loopback else []), *_ENCRYPTED])
    host = f"[{opcua.listen}]" if ":" in opcua.listen else opcua.listen
    server.set_endpoint(f"opc.tcp://{host}:{opcua.port}")
    return server


async def _listen(server: TimedServer, opcua: OpcUa) -> None:
    try:
        await server.start()
    except OSError as error:
        raise ValueError(
            f"plant.opcua: cannot listen at {opcua.listen}, port {opcua.port}: "
            f"{error.strerror or error}; end the program that listens there, or choose another port"
        ) from error


class _Shown:
    """What is shown to clients: the view of the cell, and how it goes on."""

    def __init__(self, unit: Unit, transitions: Transitions) -> None:
        self.view = PackmlView()
        self.closed = False
        self._unit, self._transitions = unit, transitions
        self._loop = asyncio.get_running_loop()
        self._heard: asyncio.Queue[_Heard] = asyncio.Queue()
        self._turn = asyncio.Lock()

    def follow(self, client: Client) -> None:
        """Hear what happens, in a thread, until the client is closed."""
        while not self.closed:
            try:
                for message in client.follow():
                    self._hear(message)
            except ProtocolError as error:
                _LOG.error("%s", error)
                self._hear(None)
                time.sleep(_AGAIN_S)

    def lost(self) -> None:
        """The cell is there no more; from the thread that follows."""
        _LOG.warning("the cell has ended, or was lost")
        self._hear(None)

    def found(self) -> None:
        """It is there again as it was; from the thread that follows."""
        _LOG.warning("the cell is there again")
        self._hear(_CellReturned.AGAIN)

    def _hear(self, message: _Heard) -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody looks any more
            self._loop.call_soon_threadsafe(self._heard.put_nowait, message)

    async def refused(self, reason: str) -> None:
        """Show why a command was refused; empty = it was not."""
        async with self._turn:
            self.view = replace(self.view, refusal=reason)
            await self._unit.show(self.view, time.time(), time.monotonic())

    async def show(self) -> None:
        """Show every message on its own, so that subscribers see each, and times now and then.

        Until it is cancelled or closed: `asyncio.wait_for` of Python 3.11 forgets that it was
        cancelled if a message comes just then.
        """
        await self._unit.show(self.view, time.time(), time.monotonic())
        while not self.closed:
            try:
                async with asyncio.timeout(_TICK_S):
                    message = await self._heard.get()
            except TimeoutError:
                async with self._turn:
                    await self._unit.show(self.view, time.time(), time.monotonic())
                continue
            async with self._turn:
                try:
                    await self._take(message)
                except Exception:  # one message must not end the server
                    _LOG.exception("%s", message)

    async def _take(self, message: _Heard) -> None:
        before, at_s, now_s = self.view, time.time(), time.monotonic()
        match message:
            case None:
                self.view = before.lost(now_s)
            case _CellReturned():
                self.view = before.found()
            case Status():
                self.view = before.after_status(message, now_s, at_s)
            case Notice():
                at_s, now_s = message.time_s, message.ran_s
                self.view = before.after_notice(message)
        await self._unit.show(self.view, at_s, now_s)
        if isinstance(message, Notice) and message.kind is MessageKind.STATE:
            await self._transitions.tell(before, self.view, at_s)


class _Forward(logging.Handler):
    """Hands messages of the library to the log of this program."""

    def emit(self, record: logging.LogRecord) -> None:
        logging.getLogger(f"{__package__}.library").handle(record)


def _forward_messages() -> None:
    library = logging.getLogger("asyncua")
    library.handlers, library.propagate = [_Forward()], False
    library.setLevel(logging.WARNING)
