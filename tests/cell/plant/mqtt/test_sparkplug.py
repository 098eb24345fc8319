"""Births, data and deaths of the edge node, read by a decoder that shares nothing with ours."""

from __future__ import annotations

import signal
import struct
from collections.abc import Callable, Iterator
from typing import Any

from cell.plant.link import Link
from tests.cell.plant.mqtt.conftest import Adapter, Broker, Receiver, result
from tests.waiting import wait_until

#: Of a command: the metric `Node Control/Rebirth`, boolean, true.
REBIRTH = b"\x0a\x14Node Control/Rebirth\x20\x0b\x70\x01"


def fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Number and value of every field of a protobuf message, from its wire format."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(data):
        key = varint()
        match key & 7:
            case 0:
                yield key >> 3, varint()
            case 1:
                (value,) = struct.unpack_from("<d", data, at)
                at += 8
                yield key >> 3, value
            case 2:
                size = varint()
                at += size
                yield key >> 3, data[at - size : at]
            case _:
                raise AssertionError(key)


#: Three messages each: more than 256, where the sequence number begins anew.
CYCLES = 90


def read(payload: bytes) -> tuple[int | None, list[dict[int, Any]]]:
    """`seq` and the metrics of a payload, each by its fields' numbers."""
    found = list(fields(payload))
    assert [n for n, _ in found].count(1) == 1, "every payload has one timestamp"
    seq = next((value for number, value in found if number == 3), None)
    return seq, [dict(fields(value)) for number, value in found if number == 2]


def test_an_edge_node_is_born_sends_data_is_reborn_and_dies(
    broker: Broker,
    link: Link,
    receiver: Callable[[str], Receiver],
    adapter: Callable[..., Adapter],
) -> None:
    broker.start()
    heard = receiver("spBv1.0/plant/#")
    running = adapter(format="sparkplug", group="plant")
    wait_until(lambda: bool(heard.of("/NBIRTH/L1")))

    def told(metric: str, field: int, *kinds: str) -> list[Any]:
        names = names_of(heard.of("/NBIRTH/")[-1].payload)
        return [
            found[field]
            for message in (m for kind in kinds for m in heard.of(kind))
            for found in read(message.payload)[1]
            if names.get(found.get(2)) == metric
        ]

    # who follows the cell from later on is told first how it stands then, and what was before after
    wait_until(lambda: 1 in told("Cell/Connected", 14, "/NBIRTH/", "/NDATA/"))
    for cycle in range(1, CYCLES + 1):
        result(link, cycle)

    def results() -> list[int]:
        return told("Result/cycle", 11, "/NDATA/")

    heard.wait_for("/NDATA/", 3 * CYCLES)
    wait_until(lambda: len(results()) >= CYCLES)
    assert results() == list(range(1, CYCLES + 1))
    birth = heard.of("/NBIRTH/")[0]
    seq, metrics = read(birth.payload)
    assert (seq, birth.qos, birth.retain) == (0, 0, False)
    aliases = [m[2] for m in metrics if 2 in m]
    assert len(set(aliases)) == len(aliases) == len(metrics) - 2
    by_name = {m[1].decode(): m for m in metrics}
    assert by_name["Cell/State"][15] == b"idle"
    assert by_name["Cell/Step"][7] == 1, "null, because nothing is under way"
    assert by_name["Node Control/Rebirth"][14] == 0
    assert (by_name["bdSeq"][4], by_name["bdSeq"][11]) == (4, 0)
    data = [read(m.payload)[0] for m in heard.of("/NDATA/")]
    assert data == [n % 256 for n in range(1, len(data) + 1)]
    assert len(data) > 256, "the number has begun anew"

    heard.say("spBv1.0/plant/NCMD/L1", b"\x12" + bytes([len(REBIRTH)]) + REBIRTH)
    wait_until(lambda: len(heard.of("/NBIRTH/")) == 2)
    assert read(heard.of("/NBIRTH/")[1].payload)[0] == 0

    running.end(signal.SIGKILL)
    wait_until(lambda: bool(heard.of("/NDEATH/")))
    death = heard.of("/NDEATH/")[-1]
    seq, metrics = read(death.payload)
    assert (seq, death.qos) == (None, 1)
    assert [(m[1], m[4], m[11]) for m in metrics] == [(b"bdSeq", 4, 0)]


def names_of(birth: bytes) -> dict[int | None, str]:
    return {m[2]: m[1].decode() for m in read(birth)[1] if 2 in m}
