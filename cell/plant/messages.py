"""Messages between a running cell and other programs: status, notices, requests; as JSON.

The status after a notice is a pure function, the same in the cell and in its clients.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from pydantic import TypeAdapter

from cell.run.machine import TRANSITIONS, CellState, MachineEvent

#: Of the messages; a program that speaks another version is refused.
PROTOCOL = 2

#: Commands of persons and other machines; `done` is the cell's own.
COMMANDS = frozenset(MachineEvent) - {MachineEvent.DONE}


class Mode(StrEnum):
    """Unit mode of the cell, after PackML."""

    PRODUCTION = "production"
    MAINTENANCE = "maintenance"
    MANUAL = "manual"


class MessageKind(StrEnum):
    """Kind of a notice; its `data` are those listed here.

    STATE         state, step = null, since (Unix time, s)
    STEP          step, cycle
    CYCLE         a cycle begins: cycle, part, product; its model and calibration, if it has one
    RESULT        a cycle has ended: `Result.to_json()`
    FAULT         `FaultNotice`
    ACKNOWLEDGED  by, note
    PRODUCT       product: what the next cycle makes; its model and calibration
    WAITING       waiting_for: what the cell waits for; empty = for nothing
    ADAPTER       adapter, trouble: one that the service started has ended; empty = it runs again
    """

    STATE = "state"
    STEP = "step"
    CYCLE = "cycle"
    RESULT = "result"
    FAULT = "fault"
    ACKNOWLEDGED = "acknowledged"
    PRODUCT = "product"
    WAITING = "waiting"
    ADAPTER = "adapter"


@dataclass(frozen=True)
class FaultNotice:
    """A fault that nobody has acknowledged yet: what, why, and what a person can do.

    time_s  Unix time
    """

    cycle: int
    step: str
    cause: str
    time_s: float
    device: str | None = None
    remedy: str = ""
    cable: str = ""
    code: str = ""


@dataclass(frozen=True)
class Status:
    """State of a cell at one moment.

    run            identifies the process of the cell: another one counts notices anew
    sequence       of the newest notice that is contained in this status
    since_s        when the state began, Unix time
    cycle          number of the cycle under way or of the last one; 0 = none yet
    part, product  of that cycle; None = none
    counts         cycles of this run by outcome
    state_seconds  time spent in each state in this run, s
    possible       commands that the present state accepts
    waiting_for    why nothing happens: `start`, `part`, `downstream`, `acknowledgement`, …
    adapters       troubles with programs that the service started beside it, by name
    last           the newest result, as in its notice
    line, model, calibration, software   as in the ledger; of that product
    """

    run: str
    sequence: int
    state: CellState
    since_s: float
    mode: Mode = Mode.PRODUCTION
    step: str | None = None
    cycle: int = 0
    part: str | None = None
    product: str | None = None
    products: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    state_seconds: Mapping[str, float] = field(default_factory=dict)
    possible: tuple[MachineEvent, ...] = ()
    waiting_for: tuple[str, ...] = ()
    fault: FaultNotice | None = None
    adapters: Mapping[str, str] = field(default_factory=dict)
    last: Mapping[str, Any] | None = None
    line: str = ""
    model: str | None = None
    calibration: str | None = None
    software: str = ""


@dataclass(frozen=True)
class Notice:
    """An event in a cell.

    sequence  counts from 1 in each run, without a gap
    time_s    Unix time
    data      as listed in `MessageKind`
    ran_s     when it was on the computer's own clock, which nobody sets: for durations
    """

    run: str
    sequence: int
    time_s: float
    kind: MessageKind
    data: Mapping[str, Any]
    ran_s: float = 0.0


@dataclass(frozen=True)
class Request:
    """A command from outside the cell's process.

    command  one of `COMMANDS`; None = only `product` is requested, or without it a person
             acknowledges, and nothing moves
    by       who asks: `plc`, `opcua:alice`, `web:bob`
    note     of an acknowledgement (`clear`, `reset`, or alone): action of the person
    part     of a `start`: id of the cable
    product  of a `start`, or alone: product of the next cycles
    asked_s  time of the request, on the monotonic clock, which all programs of a computer share
    """

    command: MachineEvent | None
    by: str
    note: str = ""
    part: str | None = None
    product: str | None = None
    asked_s: float = field(default_factory=time.monotonic, compare=False)


@dataclass(frozen=True)
class CommandReply:
    """Answer to a request.

    accepted  whether it was carried out or latched
    reason    why it was refused, with the commands possible now
    state     of the cell after it
    wrong     entry that is refused in every state: `part`, `product`, or `asked_s`
    """

    accepted: bool
    state: CellState
    reason: str = ""
    wrong: str = ""


_FAULT = TypeAdapter(FaultNotice)


def possible_in(
    state: CellState, obeyed: Collection[MachineEvent] = COMMANDS
) -> tuple[MachineEvent, ...]:
    """Commands that a state accepts, in the order of the table of transitions.

    obeyed  those that the cell obeys at all
    """
    known = (MachineEvent(event) for source, event, _ in TRANSITIONS if source == state)
    return tuple(event for event in known if event in obeyed)


def status_after(
    status: Status, notice: Notice, obeyed: Collection[MachineEvent] = COMMANDS
) -> Status:
    """Status updated by a notice; the times in each state are not advanced."""
    status, data = replace(status, sequence=notice.sequence), notice.data
    match notice.kind:
        case MessageKind.STATE:
            state = CellState(data["state"])
            return replace(
                status,
                state=state,
                since_s=data["since"],
                step=None,
                possible=possible_in(state, obeyed),
            )
        case MessageKind.STEP:
            return replace(status, step=data["step"])
        case MessageKind.CYCLE:
            part, product = data["part"], data["product"]
            status = replace(status, cycle=data["cycle"], part=part, product=product)
            return _of_product(status, data)
        case MessageKind.RESULT:
            outcome = data["outcome"]
            counts = {**status.counts, outcome: status.counts.get(outcome, 0) + 1}
            return replace(status, counts=counts, last=data)
        case MessageKind.FAULT:
            return replace(status, fault=_FAULT.validate_python(data))
        case MessageKind.ACKNOWLEDGED:
            return replace(status, fault=None)
        case MessageKind.PRODUCT:
            return _of_product(replace(status, product=data["product"]), data)
        case MessageKind.WAITING:
            return replace(status, waiting_for=tuple(data["waiting_for"]))
        case MessageKind.ADAPTER:
            others = {k: v for k, v in status.adapters.items() if k != data["adapter"]}
            trouble = {data["adapter"]: data["trouble"]} if data["trouble"] else {}
            return replace(status, adapters={**others, **trouble})


def _of_product(status: Status, data: Mapping[str, Any]) -> Status:
    """Status with model and calibration of a product, if the notice has them."""
    model, calibration = (data.get(k, getattr(status, k)) for k in ("model", "calibration"))
    return replace(status, model=model, calibration=calibration)
