"""What the adapter does while nobody is there to be told, and of a cell faster than its disk."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace

import aiomqtt
import pytest

from cell.plant.link import Link
from cell.plant.messages import Notice
from cell.plant.mqtt.adapter import MqttAdapter
from cell.plant.mqtt.form import PayloadForm
from cell.plant.mqtt.outbox import MqttOutbox
from cell.plant.mqtt.plain_json import PlainJson
from cell.plant.mqtt.sparkplug import EdgeNode
from cell.settings.plant import Mqtt
from tests.cell.plant.mqtt.conftest import result


class PatientNode(EdgeNode):
    """An edge node that notices when the adapter looks again and again without a pause."""

    looks = 0

    def can_publish(self) -> bool:
        self.looks += 1
        assert self.looks < 100, "it looks without a pause, and nothing else gets its turn"
        return super().can_publish()


class Broker:
    """A broker that says that the primary host is away, and then that it has come."""

    def __init__(self, ended: asyncio.Event) -> None:
        self.published: list[str] = []
        self._ended = ended

    async def __aenter__(self) -> Broker:
        return self

    async def __aexit__(self, *_: object) -> None:
        return None

    async def subscribe(self, topic: str, qos: int) -> None:
        await asyncio.sleep(0)

    async def publish(self, topic: str, payload: bytes, qos: int, retain: bool) -> None:
        self.published.append(topic)
        if "NBIRTH" in topic:
            self._ended.set()

    @property
    async def messages(self) -> AsyncIterator[SimpleNamespace]:
        for online in (False, False, True):
            said = json.dumps({"online": online, "timestamp": 1}).encode()
            topic = SimpleNamespace(value="spBv1.0/STATE/scada")
            yield SimpleNamespace(topic=topic, payload=said, retain=False)
            for _ in range(5):
                await asyncio.sleep(0)
        await asyncio.Event().wait()


def adapter_of(outbox: MqttOutbox, folder: Path, form: Callable[[], PayloadForm]) -> MqttAdapter:
    return MqttAdapter(Mqtt(broker="localhost"), "cell", folder / "runs", outbox, form)


def test_a_primary_host_that_is_away_is_waited_for_without_blocking(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outbox = MqttOutbox(tmp_path / "mqtt.sqlite", 10)

    async def born() -> list[str]:
        begun = asyncio.Event()
        broker = Broker(begun)
        monkeypatch.setattr(aiomqtt, "Client", lambda *_, **__: broker)
        adapter = adapter_of(outbox, tmp_path, lambda: PatientNode("plant", "cell", 1, "scada"))
        running = asyncio.create_task(adapter.run())
        started = asyncio.create_task(begun.wait())
        await asyncio.wait((running, started), return_when=asyncio.FIRST_COMPLETED)
        adapter.end()
        await running
        started.cancel()
        return broker.published

    assert "spBv1.0/plant/NBIRTH/cell" in asyncio.run(born())
    outbox.close()


class SlowOutbox(MqttOutbox):
    """On a disk that is slower than the cell and than the broker."""

    def put(self, notice: Notice) -> None:
        time.sleep(0.15)
        super().put(notice)


class Listener(Broker):
    """A broker of plain JSON: the cycle of each result and of each status, in order."""

    def __init__(self, ended: asyncio.Event) -> None:
        super().__init__(ended)
        self.reached = asyncio.Event()

    async def publish(self, topic: str, payload: bytes, qos: int, retain: bool) -> None:
        kind, said = topic.rpartition("/")[2], json.loads(payload)
        if kind == "connection" and said["cell"]:
            self.reached.set()
        if kind in ("result", "status"):
            self.published.append(f"{kind} {said['data']['cycle']}")
            if self.published[-1] == f"status {CYCLES}":
                self._ended.set()

    @property
    async def messages(self) -> AsyncIterator[SimpleNamespace]:
        await asyncio.Event().wait()
        yield SimpleNamespace()


CYCLES = 5


def test_no_status_says_more_than_the_notices_that_were_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, link: Link
) -> None:
    outbox = SlowOutbox(tmp_path / "mqtt.sqlite", 100)

    async def told() -> list[str]:
        ended = asyncio.Event()
        broker = Listener(ended)
        monkeypatch.setattr(aiomqtt, "Client", lambda *_, **__: broker)
        adapter = adapter_of(outbox, tmp_path, lambda: PlainJson("cell/L1"))
        running = asyncio.create_task(adapter.run())
        await broker.reached.wait()
        for cycle in range(1, CYCLES + 1):
            result(link, cycle)
        async with asyncio.timeout(60.0):
            await ended.wait()
        adapter.end()
        await running
        return broker.published

    published = asyncio.run(told())
    outbox.close()
    results = [f"result {cycle}" for cycle in range(1, CYCLES + 1)]
    assert [said for said in published if said.startswith("result")] == results
    assert published[0] == "status 0"
    for at, said in enumerate(published):
        kind, cycle = said.split()
        assert kind == "result" or cycle == "0" or f"result {cycle}" in published[:at]
