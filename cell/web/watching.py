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

#: A cell that says nothing for so long is shown as unknown, s; a sign of life is sent every 0.4 s.
UNKNOWN_S = 1.3
#: The ledger is asked again after so long, s: after a result, and in between.
_ASK_S = 2.0
#: Outcomes of cycles that were to insert a cable, and how many of the newest are shown.
CABLES = (Outcome.INSERTED, Outcome.MISSED, Outcome.REJECTED, Outcome.FAILED)
MOST_CABLES = 20


@dataclass(frozen=True)
class ShiftFigures:
    """Figures of the current shift from the ledger.

    counts   cycles by outcome
    reasons  code of a fault, or "rejected" or "missed"; number of cycles, newest cause; most first
    is_planned  whether the settings say when shifts begin: else no time was planned for work
    newest   the newest cables, whenever they were, oldest first
    """

    counts: dict[str, int]
    shift: Shift | None
    reasons: tuple[tuple[str, int, str], ...]
    is_planned: bool = True
    newest: tuple[ListedCycle, ...] = ()


@dataclass(frozen=True)
class WatchedState:
    """State of the cell as known to the pages at one moment.

    status        None = no cell was seen yet
    connected     whether a cell runs now
    unknown_s     since when nothing was heard of a cell that may run, Unix time; None = it was
    step_since_s  when the step under way began, Unix time
    note          why nothing is known, in words
    """

    status: Status | None = None
    connected: bool = False
    unknown_s: float | None = None
    step_since_s: float | None = None
    figures: ShiftFigures | None = None
    note: str = ""

    @property
    def may_run(self) -> bool:
        """Whether a cell runs, or one that says nothing may: it has the devices."""
        return self.connected or self.unknown_s is not None


class CellWatch:
    """Follows the cell within a `with`; `seen` is the newest state, for any thread."""

    def __init__(self, client: Client, settings: Settings, runs: Path) -> None:
        self._seen = WatchedState()
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
        """What is known now."""
        client, seen = self._client, self._seen
        age_s, silent = time.monotonic() - client.heard_s, client.away is not None
        if silent and isinstance(client.away, NoCellError):
            return replace(seen, connected=False)
        if seen.status is not None and (silent or age_s > UNKNOWN_S):
            return replace(seen, connected=False, unknown_s=time.time() - age_s)
        return seen

    def lost(self) -> None:
        """The cell is there no more: for the client's `on_lost`."""
        self._set(connected=False)

    def reconnected(self) -> None:
        """It is there again as it was: for the client's `on_there`."""
        self._set(connected=True)

    def _set(self, **known: Any) -> None:
        with self._lock:
            self._seen = replace(self._seen, **known)

    def _follow(self) -> None:
        try:
            for message in self._client.follow():
                with self._lock:
                    self._seen = state_after(self._seen, message)
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
        """Take what was done at the pages into the ledger, if there is one."""
        log, ledger = audit_file(self._runs), self._settings.ledger
        try:
            size = log.stat().st_size if log.exists() else 0
            if ledger is None or size == self._listed_bytes:
                return
            take_over(ledger.url or self._runs, log, line_name(self._settings))
            self._listed_bytes = size
        except (LedgerError, OSError) as error:  # next time
            _LOG.info("%s", error)


def state_after(seen: WatchedState, message: Notice | Status) -> WatchedState:
    """The watched state, updated by a message of the cell."""
    if isinstance(message, Status):
        begun = time.time() if message.step else None
        return replace(seen, status=message, connected=True, step_since_s=begun)
    if seen.status is None:
        return seen
    status = status_after(seen.status, message)
    begun = seen.step_since_s
    if message.kind is MessageKind.STEP:
        begun = message.time_s
    elif status.step is None:
        begun = None
    return replace(seen, status=status, connected=True, step_since_s=begun)


def read_ledger(
    settings: Settings, runs: Path, read: Callable[[Ledger], Read]
) -> tuple[Read | None, str]:
    """What `read` finds in the ledger; None, and why, if there is none or it cannot be read."""
    if settings.ledger is None:
        return None, "the settings say `ledger: null`: no cycles are listed"
    try:
        with closing(Ledger(settings.ledger.url or runs)) as ledger:
            return read(ledger), ""
    except LedgerError as error:
        return None, str(error)


def shift_figures(settings: Settings, runs: Path, now: datetime) -> ShiftFigures | None:
    """Figures of the shift under way; None = there is no ledger, or it cannot be read."""
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
