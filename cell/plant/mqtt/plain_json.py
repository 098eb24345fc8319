"""Topics of plain JSON: `{prefix}/{line}/{topic}`, one object each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from pydantic import TypeAdapter

from cell.files.plain import plain
from cell.plant.messages import FaultNotice, MessageKind, Notice, Status
from cell.plant.mqtt.form import Message, PublishedState
from cell.records.result import Result
from cell.run.machine import CellState

#: Version of the messages; a receiver refuses an unknown one.
VERSION = 1
CONNECTION, STATUS = "connection", "status"
#: Like status and connection, these hold until the next message: the broker retains them.
_RETAINED = frozenset({MessageKind.STATE, MessageKind.PRODUCT, MessageKind.WAITING})


class PlainJson:
    """Form of messages that any program can read.

    levels  first levels of all topics: prefix and line
    """

    subscriptions: Sequence[str] = ()

    def __init__(self, levels: str) -> None:
        self._levels = levels

    def will(self) -> Message:
        """The adapter and, as far as anybody can know, the cell are away."""
        return self._message(CONNECTION, {"adapter": False, "cell": False}, retain=True)

    def can_publish(self) -> bool:
        """Always: a broker is enough."""
        return True

    def birth(self, known: PublishedState) -> list[Message]:
        """Messages for connection and status."""
        return [self._connection(known, adapter=True), *self.of_status(known)]

    def of_notice(self, notice: Notice) -> list[Message]:
        """A message whose topic has the name of the notice's kind."""
        content = {
            "id": f"{notice.run}/{notice.sequence}",
            "run": notice.run,
            "sequence": notice.sequence,
            "time_s": notice.time_s,
            "data": notice.data,
        }
        return [self._message(notice.kind.value, content, retain=notice.kind in _RETAINED)]

    def of_status(self, known: PublishedState) -> list[Message]:
        """The status of the cell, if known."""
        if known.status is None:
            return []
        content = {"time_s": known.time_s, "data": asdict(known.status)}
        return [self._message(STATUS, content, retain=True)]

    def farewell(self, known: PublishedState) -> list[Message]:
        """As the will, with the time."""
        return [self._connection(known, adapter=False)]

    def receive(self, topic: str, payload: bytes) -> bool:
        """Ignore it: nothing is subscribed."""
        return False

    def _connection(self, known: PublishedState, *, adapter: bool) -> Message:
        """Whether adapter and cell are there; without the adapter the cell is unknown."""
        content: dict[str, Any] = {"adapter": adapter, "cell": adapter and known.is_cell}
        content |= {"dropped": known.dropped, "time_s": known.time_s}
        return self._message(CONNECTION, content, retain=True)

    def _message(self, topic: str, content: dict[str, Any], *, retain: bool) -> Message:
        text = json.dumps({"version": VERSION, **plain(content)}, ensure_ascii=False)
        return Message(f"{self._levels}/{topic}", text.encode(), 1, retain)


@dataclass(frozen=True)
class StateData:
    """A state has begun; `since` is Unix time, s."""

    state: CellState
    step: str | None
    since: float


@dataclass(frozen=True)
class StepData:
    """A step of a cycle has begun."""

    step: str | None
    cycle: int


@dataclass(frozen=True)
class CycleData:
    """A cycle begins; null = without a part's id, without products.

    Model and calibration are said with a product."""

    cycle: int
    part: str | None
    product: str | None
    model: str | None = None
    calibration: str | None = None


@dataclass(frozen=True)
class AcknowledgedData:
    """A person has acknowledged a fault."""

    by: str
    note: str


@dataclass(frozen=True)
class ProductData:
    """What the next cycles make, its model and calibration."""

    product: str | None
    model: str | None = None
    calibration: str | None = None


@dataclass(frozen=True)
class WaitingData:
    """What the cell waits for; empty = for nothing."""

    waiting_for: list[str]


@dataclass(frozen=True)
class AdapterData:
    """An adapter has ended, with the trouble, and is restarted; empty trouble = it runs again."""

    adapter: str
    trouble: str


DATA: dict[MessageKind, Any] = {
    MessageKind.STATE: StateData,
    MessageKind.STEP: StepData,
    MessageKind.CYCLE: CycleData,
    MessageKind.RESULT: Result,
    MessageKind.FAULT: FaultNotice,
    MessageKind.ACKNOWLEDGED: AcknowledgedData,
    MessageKind.PRODUCT: ProductData,
    MessageKind.WAITING: WaitingData,
    MessageKind.ADAPTER: AdapterData,
}
_TIME = {"type": "number", "description": "Unix time, s."}


def schema() -> dict[str, Any]:
    """A JSON schema for every topic, `#/$defs/{topic}`."""
    topics = {kind.value: _notice(kind) for kind in DATA}
    adapter = {"description": "Whether `cell mqtt` runs.", "type": "boolean"}
    cell = {"description": "Whether it reaches the cell.", "type": "boolean"}
    dropped = {"type": "integer", "description": "Messages dropped so far, none of them results."}
    topics[CONNECTION] = _object(
        "Who is there.  The broker's own word, after a loss, has no time.",
        {"adapter": adapter, "cell": cell, "dropped": dropped, "time_s": _TIME},
        ["adapter", "cell"],
    )
    topics[STATUS] = _object(
        "All that is known of the cell.",
        {"time_s": _TIME, "data": {"$ref": "#/$defs/Status"}},
        ["time_s", "data"],
    )
    kinds = {"Status": Status, "Result": Result, "FaultNotice": FaultNotice}
    kinds |= {k.__name__: k for k in DATA.values()}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Topics of `cell mqtt` with format: json",
        "$defs": {**topics, **_types(list(kinds.values()))},
    }


def _notice(kind: MessageKind) -> dict[str, Any]:
    identity = {"type": "string", "description": "Run and sequence: the same if sent again."}
    run = {"type": "string", "description": "Of the cell's process."}
    sequence = {
        "type": "integer",
        "minimum": 1,
        "description": "Counts what happens in a run; drop what is not above the last one.",
    }
    data = {"$ref": f"#/$defs/{DATA[kind].__name__}"}
    return _object(
        f"A notice of the kind {kind.value}.",
        {"id": identity, "run": run, "sequence": sequence, "time_s": _TIME, "data": data},
        ["id", "run", "sequence", "time_s", "data"],
    )


def _object(about: str, properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    return {
        "type": "object",
        "description": about,
        "properties": {"version": {"const": VERSION}, **properties},
        "required": ["version", *required],
    }


def _types(kinds: list[Any]) -> dict[str, Any]:
    inputs: list[tuple[Any, Literal["serialization"], TypeAdapter[Any]]] = [
        (kind, "serialization", TypeAdapter(kind)) for kind in kinds
    ]
    made, definitions = TypeAdapter.json_schemas(inputs)
    types: dict[str, Any] = definitions["$defs"]
    named = {kind.__name__: made[kind, "serialization"] for kind in kinds}
    return types | {name: s for name, s in named.items() if s.get("$ref") != f"#/$defs/{name}"}
