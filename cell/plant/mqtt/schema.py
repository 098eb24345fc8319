"""JSON schema of the topics of plain JSON, made from the types of what is sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pydantic import TypeAdapter

from cell.plant.messages import FaultNotice, MessageKind, Status
from cell.plant.mqtt.plain_json import CONNECTION, STATUS, VERSION
from cell.records.result import Result
from cell.run.machine import CellState


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
    """A person has looked at a fault."""

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
    """A program beside the cell has ended and is started again; empty = it runs again."""

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
