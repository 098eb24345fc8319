"""Publishes events of a cell on the link: states, steps, cycles, results, faults, waits."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from cell.plant.messages import CommandReply, FaultNotice, MessageKind, Request, possible_in
from cell.records.result import Result
from cell.run.commands import INTERRUPTING, PAUSING, RESUMING
from cell.run.cycle import Cell
from cell.run.machine import CellState

#: What a cell waits for, by state.
_WAITS = {
    CellState.IDLE: "start",
    CellState.STOPPED: "acknowledgement",
    CellState.ABORTED: "acknowledgement",
    CellState.HELD: "unhold",
    CellState.SUSPENDED: "unsuspend",
}
#: The cell reports these as steps, but they are none.  A step may have a state's name: `execute`.
_PAUSES = (CellState.HELD, CellState.SUSPENDED)


class Reporter:
    """Publishes each event of the cell once, in order.

    publish        of the link
    products       model and calibration of each product, as `Status` has them
    suspended_for  why the cell is suspended, if the request has a note
    """

    def __init__(
        self,
        publish: Callable[[MessageKind, Mapping[str, Any]], object],
        products: Mapping[str, Mapping[str, str | None]] | None = None,
    ) -> None:
        self.suspended_for = ""
        self._products = products or {}
        self._publish = publish
        self._state: CellState | None = None
        self._waiting: tuple[str, ...] = ()
        self._counting = threading.Lock()
        self._waited: dict[str, float] = {}
        self._since_s = time.monotonic()

    def state(self, state: CellState) -> None:
        """The cell has come to a state."""
        before, self._state = self._state, state
        self._publish(MessageKind.STATE, {"state": state.value, "step": None, "since": time.time()})
        wait = _WAITS.get(state)
        if state is CellState.STOPPED and before is CellState.CLEARING:
            wait = "reset"
        if state is CellState.SUSPENDED and self.suspended_for:
            wait = self.suspended_for
        self.waiting(*([] if wait is None else [wait]))

    def step(self, number: int, step: str) -> None:
        """A step begins; a pause is none."""
        if step not in _PAUSES:
            self._publish(MessageKind.STEP, {"step": step, "cycle": number})

    def cycle(self, number: int, part: str | None, product: str | None) -> None:
        """A cycle begins."""
        about = {} if product is None else self._products.get(product, {})
        self._publish(
            MessageKind.CYCLE, {"cycle": number, "part": part, "product": product, **about}
        )

    def result(self, result: Result) -> None:
        """A cycle has ended; its fault is published, too."""
        self._publish(MessageKind.RESULT, result.to_json())
        if result.fault is not None:
            self.fault(FaultNotice(result.cycle, time_s=time.time(), **asdict(result.fault)))

    def fault(self, fault: FaultNotice) -> None:
        """A fault that nobody has acknowledged."""
        self._publish(MessageKind.FAULT, asdict(fault))

    def acknowledged(self, by: str, note: str) -> None:
        """A person has looked at the fault."""
        self._publish(MessageKind.ACKNOWLEDGED, {"by": by, "note": note})

    def product(self, name: str) -> None:
        """Product of the next cycle."""
        self._publish(MessageKind.PRODUCT, {"product": name, **self._products.get(name, {})})

    def adapter(self, name: str, trouble: str) -> None:
        """A program that the service started has ended; empty = it runs again."""
        self._publish(MessageKind.ADAPTER, {"adapter": name, "trouble": trouble})

    def waiting(self, *reasons: str) -> None:
        """Reasons why the cell waits; published when they change."""
        if reasons != self._waiting:
            with self._counting:
                self._count()
                self._waiting = reasons
            self._publish(MessageKind.WAITING, {"waiting_for": list(reasons)})

    def take_waited(self) -> dict[str, float]:
        """Time that the cell has waited since the last call, s, by reason; from any thread.

        While it waits for several things, the time is that of the first.
        """
        with self._counting:
            self._count()
            waited, self._waited = self._waited, {}
        return waited

    def _count(self) -> None:
        now_s = time.monotonic()
        for reason in self._waiting[:1]:
            self._waited[reason] = self._waited.get(reason, 0.0) + now_s - self._since_s
        self._since_s = now_s


#: Commands that a cycle under way obeys at its next chance.
LATCHED = INTERRUPTING | PAUSING | frozenset(RESUMING.values())


def latch(cell: Cell, request: Request, *, unacknowledged: bool = False) -> CommandReply:
    """Latch a command of `LATCHED` for the current cycle, or refuse it, as `refusal`.

    A requested pause that has not begun yet can be cancelled.
    """
    event = request.command
    assert event is not None
    if not (cell.machine.can(event) or cell.commands.resumes(event)):
        return refusal(cell, event.value, unacknowledged=unacknowledged)
    cell.command(event, " by ".join(filter(None, (request.note or event.value, request.by))))
    return CommandReply(True, cell.machine.state)


def refusal(
    cell: Cell, command: str, why: str = "", wrong: str = "", *, unacknowledged: bool = False
) -> CommandReply:
    """Reply that refuses a request, with the reason and the commands possible now.

    unacknowledged  whether `acknowledge` is among these
    """
    state = cell.machine.state
    acknowledge = ["acknowledge"] if unacknowledged else []
    now = ", ".join([*acknowledge, *possible_in(state)]) or "nothing"
    because = f": {why}" if why else ""
    return CommandReply(
        False,
        state,
        f"{command!r} is refused while {state.value}{because}; possible now: {now}",
        wrong,
    )
