"""Follows the cell in a thread, so that the pages never wait for it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import datetime
from datetime import time as time_of_day
from pathlib import Path
from typing import Any, TypeVar

from cell.plant.client import Client
from cell.plant.messages import MessageKind, Notice, Status, status_after
from cell.plant.wire import NoCellError, ProtocolError
from cell.records.ledger.actions import take_over
from cell.records.ledger.effectiveness import Shift, shift_start, shifts
from cell.records.ledger.entry import LedgerError
from cell.records.ledger.ledger import Ledger, LedgerQuery, ListedCycle
from cell.records.result import Outcome
from cell.settings.model import Settings
from cell.settings.provenance import line_name
from cell.web.audit import audit_file
from drivers.threads import GuardedThread, error_text

_LOG = logging.getLogger(__name__)
Read = TypeVar("Read")

#: Silence after which a cell is shown as unknown, s; a sign of life is sent every 0.4 s.
UNKNOWN_S = 1.3
#: Intervals of queries to the ledger, s: after a result, and in between.
_ASK_S = 2.0
#: Outcomes of cycles that were to insert a cable, and number of the newest that are shown.
CABLES = (Outcome.INSERTED, Outcome.MISSED, Outcome.REJECTED, Outcome.FAILED)
MOST_CABLES = 20


@dataclass(frozen=True)
class ShiftFigures:
    """Figures of the current shift from the ledger.

    counts   cycles by outcome
    reasons  code of a fault, or "rejected" or "missed"; number of cycles, newest cause; most first
    is_planned  whether the settings have shifts: else no time was planned for work
    newest   the newest cables of any shift, oldest first
    """

    counts: dict[str, int]
    shift: Shift | None
    reasons: tuple[tuple[str, int, str], ...]
    is_planned: bool = True
    newest: tuple[ListedCycle, ...] = ()


@dataclass(frozen=True)
class WatchedState:
    """State of the cell as known to the pages at one moment.

    status        None = no cell has connected yet
    connected     whether a cell runs now
    unknown_s     beginning of the silence of a cell that may run, Unix time; None = not silent
    step_since_s  beginning of the current step, Unix time
    note          why nothing is known
    """

    status: Status | None = None
    connected: bool = False
    unknown_s: float | None = None
    step_since_s: float | None = None
    figures: ShiftFigures | None = None
    note: str = ""

    @property
    def may_run(self) -> bool:
        """Whether a cell runs, or may run silently: it has the devices."""
        return self.connected or self.unknown_s is not None


class CellWatch:
    """Follows the cell within a `with`; `state` gives the newest state, in any thread."""

    def __init__(self, client: Client, settings: Settings, runs: Path) -> None:
        self._state = WatchedState()
        self._client = client
        self._settings = settings
        self._runs = runs
        self._lock = threading.Lock()
        self._ask = threading.Event()
        self._over = False
        self._listed_bytes = 0

    def __enter__(self) -> CellWatch:
        GuardedThread("follow", self._follow, self._blind).start()
        GuardedThread("count", self._count, self._uncounted).start()
        return self

    def __exit__(self, *of_error: object) -> None:
        self._over = True
        self._ask.set()

    @property
    def state(self) -> WatchedState:
        """The present state."""
        client, state = self._client, self._state
        age_s, silent = time.monotonic() - client.heard_s, client.away is not None
        if silent and isinstance(client.away, NoCellError):
            return replace(state, connected=False)
        if state.status is not None and (silent or age_s > UNKNOWN_S):
            return replace(state, connected=False, unknown_s=time.time() - age_s)
        return state

    def lost(self) -> None:
        """Callback of the client's `on_lost`: the cell has disconnected."""
        self._set(connected=False)

    def reconnected(self) -> None:
        """Callback of the client's `on_there`: the cell is connected again, unchanged."""
        self._set(connected=True)

    def _set(self, **known: Any) -> None:
        with self._lock:
            self._state = replace(self._state, **known)

    def _follow(self) -> None:
        try:
            for message in self._client.follow():
                with self._lock:
                    self._state = state_after(self._state, message)
                if isinstance(message, Status) or message.kind is MessageKind.RESULT:
                    self._ask.set()
        except ProtocolError as error:
            _LOG.warning("%s", error)
            self._set(connected=False, note=str(error))

    def _blind(self, error: BaseException) -> None:
        self._set(connected=False, note=error_text(error))

    def _uncounted(self, error: BaseException) -> None:
        self._set(figures=None)

    def _count(self) -> None:
        while not self._over:
            figures = shift_figures(self._settings, self._runs, datetime.now().astimezone())
            self._list_actions()
            self._set(figures=figures)
            self._ask.wait(_ASK_S)
            self._ask.clear()

    def _list_actions(self) -> None:
        """Copy the actions at the pages into the ledger, if there is one."""
        log, ledger = audit_file(self._runs), self._settings.ledger
        try:
            size = log.stat().st_size if log.exists() else 0
            if ledger is None or size == self._listed_bytes:
                return
            take_over(ledger.url or self._runs, log, line_name(self._settings))
            self._listed_bytes = size
        except (LedgerError, OSError) as error:  # next time
            _LOG.info("%s", error)


def state_after(state: WatchedState, message: Notice | Status) -> WatchedState:
    """The watched state, updated by a message of the cell."""
    if isinstance(message, Status):
        begun = time.time() if message.step else None
        return replace(state, status=message, connected=True, step_since_s=begun)
    if state.status is None:
        return state
    status = status_after(state.status, message)
    begun = state.step_since_s
    if message.kind is MessageKind.STEP:
        begun = message.time_s
    elif status.step is None:
        begun = None
    return replace(state, status=status, connected=True, step_since_s=begun)


def read_ledger(
    settings: Settings, runs: Path, read: Callable[[Ledger], Read]
) -> tuple[Read | None, str]:
    """Result of `read` on the ledger; None, and why, if there is none or it cannot be read."""
    if settings.ledger is None:
        return None, "the settings say `ledger: null`: no cycles are listed"
    try:
        with closing(Ledger(settings.ledger.url or runs)) as ledger:
            return read(ledger), ""
    except LedgerError as error:
        return None, str(error)


def shift_figures(settings: Settings, runs: Path, now: datetime) -> ShiftFigures | None:
    """Figures of the current shift; None = there is no ledger, or it cannot be read."""
    if settings.ledger is None:
        return None
    options, line = settings.ledger, line_name(settings)
    begins = [time_of_day.fromisoformat(t) for t in options.shifts]
    query = LedgerQuery(since=shift_start(begins, now), line=line)

    def read(ledger: Ledger) -> ShiftFigures:
        listed = shifts(ledger, query, begins, now, options.ideal_cycle_s)
        reasons = [*ledger.faults(replace(query, fault="")), *ledger.not_inserted(query)]
        return ShiftFigures(
            ledger.count(query),
            listed[-1] if listed else None,
            tuple(sorted(reasons, key=lambda reason: -reason[1])),
            "shifts" in options.model_fields_set,
            tuple(ledger.listed(LedgerQuery(line=line, outcomes=CABLES), MOST_CABLES)),
        )

    figures, error = read_ledger(settings, runs, read)
    if error:
        _LOG.info("%s", error)
    return figures
