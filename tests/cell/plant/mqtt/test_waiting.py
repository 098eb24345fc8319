"""What the adapter does while nobody is there to be told."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace

import aiomqtt
import pytest

from cell.plant.mqtt.adapter import Access, MqttAdapter
from cell.plant.mqtt.outbox import MqttOutbox
from cell.plant.mqtt.sparkplug import EdgeNode
from cell.settings.plant import Mqtt


class PatientNode(EdgeNode):
    """An edge node that notices when the adapter looks again and again without a pause."""

    looks = 0

    def may_begin(self) -> bool:
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


def test_a_primary_host_that_is_away_is_waited_for_without_blocking(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outbox = MqttOutbox(tmp_path / "mqtt.sqlite", 10)

    async def born() -> list[str]:
        begun = asyncio.Event()
        broker = Broker(begun)
        monkeypatch.setattr(aiomqtt, "Client", lambda *_, **__: broker)
        adapter = MqttAdapter(
            Mqtt(broker="localhost"),
            Access("cell"),
            tmp_path / "runs",
            outbox,
            lambda: PatientNode("plant", "cell", 1, "scada"),
        )
        running = asyncio.create_task(adapter.run())
        started = asyncio.create_task(begun.wait())
        await asyncio.wait((running, started), return_when=asyncio.FIRST_COMPLETED)
        adapter.end()
        await running
        started.cancel()
        return broker.published

    assert "spBv1.0/plant/NBIRTH/cell" in asyncio.run(born())
    outbox.close()
