"""The status after a notice: a pure function, the same in the cell and in programs beside it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from cell.plant.messages import COMMANDS, Kind, Notice, Status
from cell.plant.wire import fault_of
from cell.run.machine import TRANSITIONS, CellState, Event


def possible_in(state: CellState, obeyed: Collection[Event] = COMMANDS) -> tuple[Event, ...]:
    """Commands that a state accepts, in the order of the table of transitions.

    obeyed  those that the cell obeys at all
    """
    known = (Event(event) for source, event, _ in TRANSITIONS if source == state)
    return tuple(event for event in known if event in obeyed)


def status_after(status: Status, notice: Notice, obeyed: Collection[Event] = COMMANDS) -> Status:
    """The status that contains a notice; the times in each state are not counted on."""
    status, data = replace(status, sequence=notice.sequence), notice.data
    match notice.kind:
        case Kind.STATE:
            state = CellState(data["state"])
            return replace(
                status,
                state=state,
                since_s=data["since"],
                step=None,
                possible=possible_in(state, obeyed),
            )
        case Kind.STEP:
            return replace(status, step=data["step"])
        case Kind.CYCLE:
            part, product = data["part"], data["product"]
            status = replace(status, cycle=data["cycle"], part=part, product=product)
            return _of_product(status, data)
        case Kind.RESULT:
            outcome = data["outcome"]
            counts = {**status.counts, outcome: status.counts.get(outcome, 0) + 1}
            return replace(status, counts=counts, last=data)
        case Kind.FAULT:
            return replace(status, fault=fault_of(data))
        case Kind.ACKNOWLEDGED:
            return replace(status, fault=None)
        case Kind.PRODUCT:
            return _of_product(replace(status, product=data["product"]), data)
        case Kind.WAITING:
            return replace(status, waiting_for=tuple(data["waiting_for"]))
        case Kind.ADAPTER:
            others = {k: v for k, v in status.adapters.items() if k != data["adapter"]}
            trouble = {data["adapter"]: data["trouble"]} if data["trouble"] else {}
            return replace(status, adapters={**others, **trouble})


def _of_product(status: Status, data: Mapping[str, Any]) -> Status:
    """With model and calibration of a product, where a notice says them."""
    model, calibration = (data.get(k, getattr(status, k)) for k in ("model", "calibration"))
    return replace(status, model=model, calibration=calibration)
