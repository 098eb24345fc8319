"""The status after a notice: a pure function, the same in the cell and in its clients."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from cell.plant.messages import COMMANDS, FaultNotice, MessageKind, Notice, Status
from cell.plant.wire import message_of
from cell.run.machine import TRANSITIONS, CellState, MachineEvent


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
            return replace(status, fault=message_of(FaultNotice, data))
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
    """With model and calibration of a product, where a notice says them."""
    model, calibration = (data.get(k, getattr(status, k)) for k in ("model", "calibration"))
    return replace(status, model=model, calibration=calibration)
