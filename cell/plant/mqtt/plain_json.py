"""Topics of plain JSON: `{prefix}/{line}/{what}`, one object each."""

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

#: Of the messages; a receiver refuses one that it does not know.
VERSION = 1
CONNECTION, STATUS = "connection", "status"
#: Beside status and connection the broker keeps what holds until the next message.
_KEPT = frozenset({MessageKind.STATE, MessageKind.PRODUCT, MessageKind.WAITING})


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
        """The broker is enough."""
        return True

    def birth(self, known: PublishedState) -> list[Message]:
        """Who is there, and the status."""
        return [self._connection(known, adapter=True), *self.of_status(known)]

    def of_notice(self, notice: Notice) -> list[Message]:
        """A message of the topic that is called as the kind of the notice."""
        said = {
            "id": f"{notice.run}/{notice.sequence}",
            "run": notice.run,
            "sequence": notice.sequence,
            "time_s": notice.time_s,
            "data": notice.data,
        }
        return [self._message(notice.kind.value, said, retain=notice.kind in _KEPT)]

    def of_status(self, known: PublishedState) -> list[Message]:
        """All that is known of the cell now."""
        if known.status is None:
            return []
        said = {"time_s": known.time_s, "data": asdict(known.status)}
        return [self._message(STATUS, said, retain=True)]

    def farewell(self, known: PublishedState) -> list[Message]:
        """As the will, with the time."""
        return [self._connection(known, adapter=False)]

    def receive(self, topic: str, payload: bytes) -> bool:
        """Nothing was asked for, so nothing is obeyed."""
        return False

    def _connection(self, known: PublishedState, *, adapter: bool) -> Message:
        """Who is there; without the adapter nobody knows of the cell."""
        said: dict[str, Any] = {"adapter": adapter, "cell": adapter and known.is_cell}
        said |= {"dropped": known.dropped, "time_s": known.time_s}
        return self._message(CONNECTION, said, retain=True)

    def _message(self, what: str, said: dict[str, Any], *, retain: bool) -> Message:
        text = json.dumps({"version": VERSION, **plain(said)}, ensure_ascii=False)
        return Message(f"{self._levels}/{what}", text.encode(), 1, retain)


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
    made, found = TypeAdapter.json_schemas(inputs)
    types: dict[str, Any] = found["$defs"]
    named = {kind.__name__: made[kind, "serialization"] for kind in kinds}
    return types | {name: s for name, s in named.items() if s.get("$ref") != f"#/$defs/{name}"}
