"""Requests from outside as commands to the cell; its machine decides what a state accepts."""

from __future__ import annotations

from cell.plant.folded import possible_in
from cell.plant.messages import CommandReply, Request
from cell.run.cycle import Cell
from cell.run.machine import MachineEvent

#: Commands that a cycle under way obeys at its next chance.
LATCHED = frozenset(
    {
        MachineEvent.HOLD,
        MachineEvent.UNHOLD,
        MachineEvent.SUSPEND,
        MachineEvent.UNSUSPEND,
        MachineEvent.STOP,
        MachineEvent.ABORT,
    }
)


def latch(cell: Cell, request: Request) -> CommandReply:
    """Give a command of `LATCHED` to the cycle under way, or refuse it.

    A pause that was asked for and has not begun yet can be taken back.
    """
    event = request.command
    assert event is not None
    if not (cell.machine.can(event) or cell.commands.resumes(event)):
        return refusal(cell, event.value)
    cell.command(event, " by ".join(filter(None, (request.note or event.value, request.by))))
    return CommandReply(True, cell.machine.state)


def refusal(cell: Cell, what: str, why: str = "", wrong: str = "") -> CommandReply:
    """That something is refused, why, and what is possible; `wrong` as in `Answer`."""
    state = cell.machine.state
    now = ", ".join(possible_in(state)) or "nothing"
    because = f": {why}" if why else ""
    return CommandReply(
        False,
        state,
        f"{what!r} is refused while {state.value}{because}; possible now: {now}",
        wrong,
    )
