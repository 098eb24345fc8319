"""A cell that makes transitions and nothing else, and servers that show it."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua

from cell.plant.link import Link
from cell.plant.messages import CommandReply, MessageKind, Request, Status
from cell.plant.opcua import packml
from cell.plant.opcua.server import OWN_URI, running
from cell.plant.users import Role, Users
from cell.run.machine import CellState, EventRefusedError, Machine, MachineEvent
from cell.settings import Settings, load_settings
from cell.settings.plant import OpcUa, Plant
from tests.waiting import free_port, wait_until

CONFIG = Path(__file__).parents[4] / "config"
PASSWORD = "correct horse"
NAME = "Cell7"


class FakeCell:
    """Obeys commands by its machine of states; a cycle ends when the test says so."""

    def __init__(self, runs: Path) -> None:
        self.machine = Machine(time.time, self._tell)
        begun = Status("", 0, CellState.STOPPED, time.time(), products=("short", "long"))
        self.link = Link(runs, begun, self._obey)
        self.asked: list[Request] = []
        self.states: list[str] = []
        self.cycle = 0

    def _tell(self, state: CellState) -> None:
        self.states.append(state.value)
        self.link.publish(
            MessageKind.STATE, {"state": state.value, "step": None, "since": time.time()}
        )

    def _obey(self, request: Request) -> CommandReply:
        self.asked.append(request)
        try:
            if request.command is not None:
                self.send(request.command)
            if request.product is not None:
                self.link.publish(MessageKind.PRODUCT, {"product": request.product})
        except EventRefusedError as error:
            return CommandReply(False, self.machine.state, str(error))
        if request.note:
            self.link.publish(MessageKind.ACKNOWLEDGED, {"by": request.by, "note": request.note})
        return CommandReply(True, self.machine.state)

    def send(self, event: MachineEvent) -> None:
        """Take a transition, and those that follow by themselves."""
        self.machine.send(event)
        while self.machine.state is not CellState.EXECUTE and self.machine.can(MachineEvent.DONE):
            if self.machine.state is CellState.COMPLETING:
                result = {"outcome": "inserted", "measured_miss_m": -0.0012}
                cable = {"cycle": self.cycle, "part": f"A-{self.cycle}"}
                self.link.publish(MessageKind.RESULT, cable | result)
            self.machine.send(MachineEvent.DONE)
        if event is MachineEvent.START:
            self.cycle += 1
            self.link.publish(
                MessageKind.CYCLE,
                {"cycle": self.cycle, "part": f"A-{self.cycle}", "product": "long"},
            )

    def fail(self, cause: str) -> None:
        fault = {"cycle": 1, "step": "grasp", "cause": cause, "time_s": time.time()}
        self.link.publish(MessageKind.FAULT, {**fault, "device": "gripper", "remedy": "look at it"})
        self.send(MachineEvent.ABORT)


def settings_with(opcua: OpcUa) -> Settings:
    settings = load_settings(CONFIG / "fake.yaml")
    return settings.model_copy(update={"plant": Plant(opcua=opcua)})


@contextmanager
def served(settings: Settings, runs: Path) -> Iterator[asyncio.AbstractEventLoop]:
    """The server in a loop of its own, in a thread."""
    loop, stopped = asyncio.new_event_loop(), asyncio.Event()
    begun: list[BaseException | None] = []

    async def serve() -> None:
        try:
            async with running(settings, runs):
                begun.append(None)
                await stopped.wait()
        except BaseException as error:
            begun.append(error)

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
    thread.start()
    try:
        wait_until(lambda: bool(begun))
        if begun[0] is not None:
            raise begun[0]
        yield loop
    finally:
        loop.call_soon_threadsafe(stopped.set)
        thread.join(60.0)
        assert not thread.is_alive(), "the server does not end"
        loop.close()


@dataclass
class Seen:
    """Client of the unit `NAME` within a loop of the test."""

    client: Client
    standard: int
    own: int
    changes: list[Any] = field(default_factory=list)

    def node(self, path: str) -> Any:
        """Node of the unit; empty = the unit itself."""
        text = f"{NAME}.{path}" if path else NAME
        return self.client.get_node(ua.NodeId(text, self.own))

    async def read(self, path: str) -> Any:
        data = await self.node(path).read_data_value(raise_on_bad_status=False)
        return data.Value.Value if data.StatusCode.is_good() else data.StatusCode.name

    async def call(self, path: str, *arguments: Any) -> str:
        """Name of the status of a call."""
        of, _, method = path.rpartition(".")
        namespace = self.own if of == "Cell" else self.standard
        try:
            await self.node(of).call_method(ua.QualifiedName(method, namespace), *arguments)
        except ua.UaStatusCodeError as error:
            return str(ua.StatusCode(error.code).name)
        return "Good"

    async def until(self, path: str, value: Any) -> None:
        deadline_s = time.monotonic() + 30.0
        while (found := await self.read(path)) != value:
            assert time.monotonic() < deadline_s, (path, found, value)
            await asyncio.sleep(0.01)


@dataclass(frozen=True)
class Site:
    """A cell and a server that shows it."""

    cell: FakeCell
    port: int
    folder: Path
    runs: Path
    loop: asyncio.AbstractEventLoop | None = None

    @asynccontextmanager
    async def connected(
        self, user: str = "", certificate: Path | None = None
    ) -> AsyncIterator[Seen]:
        client = Client(f"opc.tcp://127.0.0.1:{self.port}", timeout=20)
        if user:
            client.set_user(user)
            client.set_password(PASSWORD)
        if certificate is not None:
            client.application_uri = "urn:test:client"
            mode = "Basic256Sha256,SignAndEncrypt"
            key = certificate.with_suffix(".pem")
            await client.set_security_string(f"{mode},{certificate},{key}")
        async with client:
            uris = await client.get_namespace_array()
            yield Seen(client, uris.index(packml.URI), uris.index(OWN_URI))

    def look(self, seen: Callable[[Seen], Coroutine[Any, Any, None]], **how: Any) -> None:
        """Run what a client does."""

        async def connected() -> None:
            async with self.connected(**how) as client:
                await seen(client)

        asyncio.run(connected())


@contextmanager
def site(folder: Path, listen: str) -> Iterator[Site]:
    runs, port = folder / "runs", free_port()
    if listen != "127.0.0.1":
        users = Users(folder / "opcua" / "users.json")
        users.add("ada", Role.operate, PASSWORD)
        users.add("bob", Role.watch, PASSWORD)
    opcua = OpcUa(listen=listen, port=port, folder=folder / "opcua", name=NAME)
    cell = FakeCell(runs)
    with cell.link, served(settings_with(opcua), runs) as loop:
        yield Site(cell, port, folder / "opcua", runs, loop)


@pytest.fixture(scope="session")
def loopback(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("loopback"), "127.0.0.1") as opened:
        yield opened


@pytest.fixture(scope="session")
def beyond(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Listens at all addresses of this computer."""
    with site(tmp_path_factory.mktemp("beyond"), "0.0.0.0") as opened:
        yield opened


@pytest.fixture
def stopped(loopback: Site) -> Site:
    """The cell in Stopped, whatever a test before has left, and nothing recorded."""
    cell = loopback.cell
    if cell.machine.state is CellState.ABORTED:
        cell.send(MachineEvent.CLEAR)
        cell.link.publish(MessageKind.ACKNOWLEDGED, {"by": "test", "note": ""})
    if cell.machine.state is not CellState.STOPPED:
        cell.send(MachineEvent.STOP)
    cell.asked.clear()
    cell.states.clear()
    return loopback
