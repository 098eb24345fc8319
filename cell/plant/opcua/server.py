"""OPC UA server: a process that follows the cell and shows it to clients."""

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
from asyncua.common.event_objects import TransitionEvent
from asyncua.server.event_generator import EventGenerator

from cell.plant.client import Client
from cell.plant.messages import MessageKind, Notice, Status
from cell.plant.opcua import packml
from cell.plant.opcua.access import GuardedServer, own_certificate
from cell.plant.opcua.commands import Methods, TimedServer
from cell.plant.opcua.packml import MACHINE_PATHS, MACHINES, active_states, transition_between
from cell.plant.opcua.space import AddressSpace, Ids
from cell.plant.opcua.types import add_types
from cell.plant.opcua.unit import Unit, tags_of
from cell.plant.opcua.view import PackmlView
from cell.plant.users import FILE as USERS
from cell.plant.users import all_users
from cell.plant.wire import ProtocolError
from cell.settings import Settings
from cell.settings.plant import OpcUa
from cell.settings.provenance import line_name
from drivers.threads import GuardedThread

#: Severity of a transition, and of one that a fault or a stop has brought about.
_USUAL, _GRAVE = 100, 700


class Transitions:
    """Sends events about transitions to clients."""

    def __init__(self, space: AddressSpace, unit: Unit, generators: list[EventGenerator]) -> None:
        self._space, self._unit, self._generators = space, unit, generators

    @classmethod
    async def at(cls, space: AddressSpace, unit: Unit) -> Transitions:
        """Events of the server, whose sources are the state machines of a unit."""
        generators = []
        for path in MACHINE_PATHS:
            event = TransitionEvent(sourcenode=unit.id_of(path), message="")
            generators.append(
                await space.server.get_event_generator(event, emitting_node=Ids.Server)
            )
        return cls(space, unit, generators)

    async def publish(self, before: PackmlView, after: PackmlView, at_s: float) -> None:
        """Publish the transition between two views, at a Unix time."""
        if before.status is None or after.status is None:
            return
        was, now = before.status.state, after.status.state
        level, name, known = transition_between(was, now)
        event, machine = self._generators[level].event, MACHINES[level]
        ids = {s.name: self._space.node_id(s.id) for s in machine.states}
        source, target = active_states(was)[level], active_states(now)[level]
        event.Transition, event.FromState, event.ToState = map(
            ua.LocalizedText, (name, source, target)
        )
        for field, value in (
            ("FromState/Id", ids[source]),
            ("ToState/Id", ids[target]),
            ("Transition/Id", None if known is None else self._space.node_id(known.id)),
        ):
            setattr(event, field, ua.Variant(value))  # a field of any type is a variant in one
        event.Severity = _GRAVE if target in ("Aborting", "Stopping") else _USUAL
        message = f"{was.value} to {now.value}"
        await self._generators[level].trigger(datetime.fromtimestamp(at_s, UTC), message)


_LOG = logging.getLogger(__name__)

#: Namespace of nodes that PackML does not define.
OWN_URI = "urn:cable-cell:opcua"
#: Interval at which times are updated, s.
_TICK_S = 1.0
#: Pause before a cell of another version is contacted again, s.
_AGAIN_S = 5.0


class _CellReturned(Enum):
    """A lost cell is reached again, unchanged."""

    AGAIN = "again"


#: Message of the thread that follows; None = the cell was lost.
_Message = Notice | Status | _CellReturned | None

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
    ready   called with the address once clients may connect
    users   file of the users
    raises  ValueError: no section `plant.opcua`, the server cannot listen at the address, or the
            folder cannot be written; the message has the remedy
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
    """The server within a `with`; yields its address.  Raises ValueError as `serve`."""
    opcua = None if settings.plant is None else settings.plant.opcua
    if opcua is None:
        raise ValueError("the settings have no section plant.opcua; add one, it may be empty: {}")
    ideal_s = None if settings.ledger is None else settings.ledger.ideal_cycle_s
    tags = tags_of(line_name(settings), None if ideal_s is None else 60.0 / ideal_s)
    _forward_messages()
    try:
        server = await _configured_server(opcua, users)
    except OSError as error:
        raise ValueError(
            f"{error.filename or opcua.folder}: {error.strerror or error}; name another folder in "
            "plant.opcua.folder, or make it writable"
        ) from error
    own, standard = [await server.register_namespace(u) for u in (OWN_URI, packml.URI)]
    space = AddressSpace(server, standard, own)
    add_types(space)
    unit = Unit(space, opcua.name, tags)
    shown = _ViewPublisher(unit, await Transitions.at(space, unit))
    client = Client(runs, on_lost=shown.lost, on_there=shown.reconnected)
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


async def _configured_server(opcua: OpcUa, users: Path) -> TimedServer:
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


class _ViewPublisher:
    """Publishes the view of the cell and its transitions to clients."""

    def __init__(self, unit: Unit, transitions: Transitions) -> None:
        self.view = PackmlView()
        self.closed = False
        self._unit, self._transitions = unit, transitions
        self._loop = asyncio.get_running_loop()
        self._messages: asyncio.Queue[_Message] = asyncio.Queue()
        self._lock = asyncio.Lock()

    def follow(self, client: Client) -> None:
        """Receive messages of the cell, in a thread, until the client is closed."""
        while not self.closed:
            try:
                for message in client.follow():
                    self._receive(message)
            except ProtocolError as error:
                _LOG.error("%s", error)
                self._receive(None)
                time.sleep(_AGAIN_S)

    def lost(self) -> None:
        """The cell is lost; called in the thread that follows."""
        _LOG.warning("the cell has ended, or was lost")
        self._receive(None)

    def reconnected(self) -> None:
        """The cell is reached again, unchanged; called in the thread that follows."""
        _LOG.warning("the cell is there again")
        self._receive(_CellReturned.AGAIN)

    def _receive(self, message: _Message) -> None:
        with suppress(RuntimeError):  # the loop is closed, with no client any more
            self._loop.call_soon_threadsafe(self._messages.put_nowait, message)

    async def refused(self, reason: str) -> None:
        """Show the reason of a refusal; empty after an accepted command."""
        async with self._lock:
            self.view = replace(self.view, refusal=reason)
            await self._unit.show(self.view, time.time(), time.monotonic())

    async def show(self) -> None:
        """Show every message separately, so that subscribers get each, and times at intervals.

        Not by `asyncio.wait_for`: in Python 3.11 it loses a cancellation that coincides with a
        message.
        """
        await self._unit.show(self.view, time.time(), time.monotonic())
        while not self.closed:
            try:
                async with asyncio.timeout(_TICK_S):
                    message = await self._messages.get()
            except TimeoutError:
                async with self._lock:
                    await self._unit.show(self.view, time.time(), time.monotonic())
                continue
            async with self._lock:
                try:
                    await self._take(message)
                except Exception:  # one message must not end the server
                    _LOG.exception("%s", message)

    async def _take(self, message: _Message) -> None:
        before, at_s, now_s = self.view, time.time(), time.monotonic()
        match message:
            case None:
                self.view = before.lost(now_s)
            case _CellReturned():
                self.view = before.reconnected()
            case Status():
                self.view = before.after_status(message, now_s, at_s)
            case Notice():
                at_s, now_s = message.time_s, message.ran_s
                self.view = before.after_notice(message)
        await self._unit.show(self.view, at_s, now_s)
        if isinstance(message, Notice) and message.kind is MessageKind.STATE:
            await self._transitions.publish(before, self.view, at_s)


class _Forward(logging.Handler):
    """Forwards messages of the library to the log of this program."""

    def emit(self, record: logging.LogRecord) -> None:
        logging.getLogger(f"{__package__}.library").handle(record)


def _forward_messages() -> None:
    library = logging.getLogger("asyncua")
    library.handlers, library.propagate = [_Forward()], False
    library.setLevel(logging.WARNING)
