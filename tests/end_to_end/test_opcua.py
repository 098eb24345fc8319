"""A simulated cell, started, stopped and acknowledged by a client of OPC UA."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest
from asyncua import Client, ua

from cell.plant.opcua import packml
from cell.plant.opcua.server import OWN_URI
from cell.settings.plant import OpcUa
from tests.cell.plant.opcua.conftest import NAME, Seen, served, settings_with
from tests.waiting import free_port

from .forked import Forking

EXECUTE = "BaseStateMachine.MachineState.ExecuteState"
MACHINE = "BaseStateMachine.MachineState"


@pytest.fixture
def port(forking: Forking, quick_config: Path, tmp_path: Path) -> Iterator[int]:
    """That of a server beside a cell that waits for starts."""
    runs, port = tmp_path / "runs", free_port()
    opcua = OpcUa(port=port, folder=tmp_path / "opcua", name=NAME)
    process = forking.start("run", "-c", quick_config, "--cycles", "forever", "--runs", runs)
    try:
        with served(settings_with(opcua), runs):
            yield port
    finally:
        process.kill()
        process.wait(30)


class Changes:
    """States in the order in which they were told."""

    def __init__(self) -> None:
        self.states: list[str] = []

    def datachange_notification(self, node: object, value: str, data: object) -> None:
        self.states.append(value)


def test_cables_are_inserted_and_a_stop_waits_for_a_named_person(port: int) -> None:
    changes = Changes()

    async def command() -> None:
        async with Client(f"opc.tcp://127.0.0.1:{port}", timeout=20) as client:
            uris = await client.get_namespace_array()
            seen = Seen(client, uris.index(packml.URI), uris.index(OWN_URI))
            subscription = await client.create_subscription(50, changes)
            await subscription.subscribe_data_change(seen.node("Cell.State"))
            for cycle in (1, 2):
                await seen.until("Cell.State", "idle")
                assert await seen.call("Cell.Start", f"A-{cycle}", "") == "Good"
                assert await seen.call("Cell.Start", "A-9", "") == "BadInvalidState"
                await seen.until("Cell.Counts.Inserted", cycle)
                assert await seen.read("Cell.LastResult.Part") == f"A-{cycle}"
            await seen.until("Cell.State", "idle")
            assert await seen.call(f"{EXECUTE}.Start", ua.Variant(None)) == "Good"
            await seen.until("Cell.State", "execute")
            assert await seen.call(f"{MACHINE}.Stop") == "Good"
            await seen.until("Cell.State", "stopped")
            await seen.until("Cell.Fault.Cause", "stop by opcua:anonymous")
            assert await seen.call(f"{MACHINE}.Reset") == "BadInvalidState"
            assert await seen.call("Cell.Reset", "Ada", "guard closed") == "Good"
            while changes.states[-2:] != ["resetting", "idle"] or "stopped" not in changes.states:
                await asyncio.sleep(0.02)  # they are told a little later

    asyncio.run(asyncio.wait_for(command(), 120.0))
    cycle = ["starting", "execute", "completing", "complete", "resetting", "idle"]
    stopped = ["starting", "execute", "stopping", "stopped", "resetting", "idle"]
    assert changes.states[-18:] == [*cycle, *cycle, *stopped]
