"""States of the cell and the transitions between them, after PackML (ISA-TR88.00.02)."""

from __future__ import annotations

import threading
from collections.abc import Callable
from enum import StrEnum


class CellState(StrEnum):
    """State of the cell.  Held = by a person, Suspended = waiting for up- or downstream."""

    IDLE = "idle"
    STARTING = "starting"
    EXECUTE = "execute"
    COMPLETING = "completing"
    COMPLETE = "complete"
    RESETTING = "resetting"
    HOLDING = "holding"
    HELD = "held"
    UNHOLDING = "unholding"
    SUSPENDING = "suspending"
    SUSPENDED = "suspended"
    UNSUSPENDING = "unsuspending"
    STOPPING = "stopping"
    STOPPED = "stopped"
    ABORTING = "aborting"
    ABORTED = "aborted"
    CLEARING = "clearing"


class MachineEvent(StrEnum):
    """An event that changes the cell's state: commands, and `done` when a state has acted."""

    START = "start"
    RESET = "reset"
    HOLD = "hold"
    UNHOLD = "unhold"
    SUSPEND = "suspend"
    UNSUSPEND = "unsuspend"
    STOP = "stop"
    ABORT = "abort"
    CLEAR = "clear"
    DONE = "done"


_WORKING = ["idle", "starting", "execute", "completing", "complete", "resetting"]
_PAUSING = ["holding", "held", "unholding", "suspending", "suspended", "unsuspending"]

#: (from, event, to), all of them.
TRANSITIONS: tuple[tuple[str, str, str], ...] = (
    ("idle", "start", "starting"),
    ("starting", "done", "execute"),
    ("execute", "done", "completing"),
    ("completing", "done", "complete"),
    ("complete", "reset", "resetting"),
    ("resetting", "done", "idle"),
    #
    ("execute", "hold", "holding"),
    ("holding", "done", "held"),
    ("held", "unhold", "unholding"),
    ("unholding", "done", "execute"),
    #
    ("execute", "suspend", "suspending"),
    ("suspending", "done", "suspended"),
    ("suspended", "unsuspend", "unsuspending"),
    ("unsuspending", "done", "execute"),
    ("suspended", "hold", "holding"),
    #
    *((state, "stop", "stopping") for state in (*_WORKING, *_PAUSING, "clearing")),
    ("stopping", "done", "stopped"),
    ("stopped", "reset", "resetting"),
    #
    *(
        (state, "abort", "aborting")
        for state in (*_WORKING, *_PAUSING, "stopping", "stopped", "clearing")
    ),
    ("aborting", "done", "aborted"),
    ("aborted", "clear", "clearing"),
    ("clearing", "done", "stopped"),
)


def target_of(state: CellState, event: MachineEvent) -> CellState | None:
    """Where an event leads from a state; None = it is refused there."""
    return next((CellState(t) for s, e, t in TRANSITIONS if (s, e) == (state, event)), None)


class EventRefusedError(Exception):
    """An event came that the present state does not know.  Scenario: `start` while held."""


class Machine:
    """State of one cell, safe to be sent events from any thread; it begins in Stopped.

    now_s      clock in which the time spent in each state is counted, s
    on_change  called with every new state, in the thread that caused it; may be set later
    """

    def __init__(
        self, now_s: Callable[[], float], on_change: Callable[[CellState], None] | None = None
    ) -> None:
        self._now_s = now_s
        self.on_change = on_change
        self._lock = threading.RLock()
        self._since_s = now_s()
        self._seconds = dict.fromkeys(CellState, 0.0)
        self._state = CellState.STOPPED

    @property
    def state(self) -> CellState:
        """Where the cell is now."""
        return self._state

    def send(self, event: MachineEvent) -> CellState:
        """Take the transition of `event`; returns the new state.

        raises  EventRefusedError: the present state has no such transition; nothing changed
        """
        with self._lock:
            before, after = self._state, target_of(self._state, event)
            if after is None:
                allowed = ", ".join(e for s, e, _ in TRANSITIONS if s == before)
                raise EventRefusedError(
                    f"{event.value!r} is refused while {before.value}; possible now: {allowed}"
                )
            now_s = self._now_s()
            self._seconds[before] += now_s - self._since_s
            self._since_s, self._state = now_s, after
        if self.on_change is not None:
            self.on_change(after)
        return after

    def can(self, event: MachineEvent) -> bool:
        """Whether the present state knows `event`."""
        return target_of(self.state, event) is not None

    def seconds(self) -> dict[CellState, float]:
        """Time spent in every state so far, the present one included, s."""
        with self._lock:
            seconds = dict(self._seconds)
            seconds[self.state] += self._now_s() - self._since_s
            return seconds
