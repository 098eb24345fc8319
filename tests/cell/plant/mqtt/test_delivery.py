"""Every result arrives once and in order, whoever is killed."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from typing import Any

import jsonschema
import paho.mqtt.client as paho

from cell.plant.link import Link
from cell.plant.messages import MessageKind
from cell.plant.mqtt.plain_json import schema
from tests.cell.plant.mqtt.conftest import Adapter, Broker, Receiver, result
from tests.waiting import wait_until

CYCLES = 100


def once(messages: list[paho.MQTTMessage]) -> list[dict[str, Any]]:
    """As docs/howto/mqtt.md tells a receiver: what is not above the last sequence is dropped."""
    kept: list[dict[str, Any]] = []
    for said in (json.loads(message.payload) for message in messages):
        if not kept or kept[-1]["run"] != said["run"] or said["sequence"] > kept[-1]["sequence"]:
            kept.append(said)
    return kept


def cycles(receiver: Receiver) -> list[int]:
    return [said["data"]["cycle"] for said in once(receiver.of("/result"))]


def wait_for(receiver: Receiver, count: int) -> None:
    """Until so many results have arrived."""
    receiver.wait_for("/result", count)  # cheap: nothing is parsed
    wait_until(lambda: len(cycles(receiver)) >= count)


def valid(messages: list[paho.MQTTMessage]) -> None:
    whole, of_topic = schema(), {}
    for message in messages:
        kind = message.topic.rpartition("/")[2]
        if kind not in of_topic:
            wanted = {**whole, "$ref": f"#/$defs/{kind}"}
            jsonschema.Draft202012Validator.check_schema(wanted)
            of_topic[kind] = jsonschema.Draft202012Validator(wanted)
        of_topic[kind].validate(json.loads(message.payload))


def test_a_broker_that_is_killed_twice_gets_every_result_once_and_in_order(
    broker: Broker,
    link: Link,
    receiver: Callable[[str], Receiver],
    adapter: Callable[..., Adapter],
) -> None:
    broker.start()
    heard = receiver("cable-cell/#")
    adapter()
    for cycle in range(1, CYCLES + 1):
        result(link, cycle)
        if cycle in (30, 60):
            wait_for(heard, cycle - 20)
            broker.kill()
            before = heard.subscribed
            broker.start()
            wait_until(lambda n=before: heard.subscribed > n)
    wait_for(heard, CYCLES)
    assert cycles(heard) == list(range(1, CYCLES + 1))
    wait_until(lambda: json.loads(heard.of("/status")[-1].payload)["data"]["cycle"] == CYCLES)
    valid(heard.heard)


def test_an_adapter_that_is_killed_goes_on_where_it_was(
    broker: Broker,
    link: Link,
    receiver: Callable[[str], Receiver],
    adapter: Callable[..., Adapter],
) -> None:
    broker.start()
    heard = receiver("cable-cell/#")
    first = adapter()
    for cycle in range(1, CYCLES + 1):
        result(link, cycle)
        if cycle == CYCLES // 2:
            wait_for(heard, CYCLES // 4)
            first.end(signal.SIGKILL)
            assert json.loads(heard.of("/connection")[0].payload)["adapter"] is True
            wait_until(lambda: json.loads(heard.of("/connection")[-1].payload)["adapter"] is False)
    second = adapter()
    wait_for(heard, CYCLES)
    assert cycles(heard) == list(range(1, CYCLES + 1))
    assert second.end(signal.SIGTERM) == 0
    wait_until(lambda: "time_s" in json.loads(heard.of("/connection")[-1].payload))
    assert json.loads(heard.of("/connection")[-1].payload)["adapter"] is False
    valid(heard.heard)


def test_what_happens_while_the_broker_is_away_waits(
    broker: Broker,
    link: Link,
    receiver: Callable[[str], Receiver],
    adapter: Callable[..., Adapter],
) -> None:
    adapter()
    for cycle in range(1, 6):
        result(link, cycle)
    link.publish(MessageKind.WAITING, {"waiting_for": ["part"]})
    broker.start()
    heard = receiver("cable-cell/L1/#")
    wait_until(lambda: bool(heard.of("/waiting")))
    late = json.loads(heard.of("/waiting")[-1].payload)
    assert late["data"] == {"waiting_for": ["part"]}
    assert late["sequence"] == 3 * 5 + 1
