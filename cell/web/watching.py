"""The cell as the pages' process sees it: followed in a thread, never waited for."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, replace
from datetime import datetime
from datetime import time as time_of_day
from pathlib import Path

from cell.plant.client import Client
from cell.plant.messages import MessageKind, Notice, Status
from cell.plant.status_reducer import status_after
from cell.plant.wire import NoCellError, ProtocolError
from cell.records.ledger.actions import take_over
from cell.records.ledger.effectiveness import Shift, shift_start, shifts
from cell.records.ledger.entry import LedgerError
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.settings.model import Settings
from cell.settings.provenance import line_name
from cell.settings.records import LedgerSettings as LedgerSettings
from cell.web.audit import audit_file
from drivers.threads import GuardedThread, said

_LOG = logging.getLogger(__name__)

#: A cell that says nothing for so long is shown as unknown, s; a sign of life is sent every 0.4 s.
UNKNOWN_S = 1.3
#: The ledger is asked again after so long, s: after a result, and in between.
_ASK_S = 2.0


@dataclass(frozen=True)
class ShiftFigures:
    """What the ledger says of the shift under way.

    counts   cycles by outcome
    reasons  code of a fault, or "rejected" or "missed"; number of cycles, newest cause; most first
    is_planned  whether the settings say when shifts begin: else no time was planned for work
    """

    counts: dict[str, int]
    shift: Shift | None
    reasons: tuple[tuple[str, int, str], ...]
    is_planned: bool = True


@dataclass(frozen=True)
class WatchedState:
    """What is known of the cell at one moment.

    status        None = no cell was seen yet
    there         whether a cell runs now
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
    """Follows the cell within a `with`; `seen` is what is known, from any thread."""

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
        with self._lock:
            self._seen = replace(self._seen, connected=False)

    def reconnected(self) -> None:
        """It is there again as it was: for the client's `on_there`."""
        with self._lock:
            self._seen = replace(self._seen, connected=True)

    def _follow(self) -> None:
        try:
            for message in self._client.follow():
                with self._lock:
                    self._seen = state_after(self._seen, message)
                if isinstance(message, Status) or message.kind is MessageKind.RESULT:
                    self._ask.set()
        except ProtocolError as error:
            _LOG.warning("%s", error)
            with self._lock:
                self._seen = replace(self._seen, connected=False, note=str(error))

    def _blind(self, error: BaseException) -> None:
        with self._lock:
            self._seen = replace(self._seen, connected=False, note=said(error))

    def _uncounted(self, error: BaseException) -> None:
        with self._lock:
            self._seen = replace(self._seen, figures=None)

    def _count(self) -> None:
        while not self._over:
            figures = shift_figures(self._settings, self._runs, datetime.now().astimezone())
            self._list_actions()
            with self._lock:
                self._seen = replace(self._seen, figures=figures)
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
    """What is known after a message of the cell."""
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


def shift_figures(settings: Settings, runs: Path, now: datetime) -> ShiftFigures | None:
    """Figures of the shift under way; None = there is no ledger, or it cannot be read."""
    if settings.ledger is None:
        return None
    given: LedgerSettings = settings.ledger
    begins = [time_of_day.fromisoformat(t) for t in given.shifts]
    begun = shift_start(begins, now)
    wanted = LedgerQuery(since=begun, line=line_name(settings))
    try:
        ledger = Ledger(given.url or runs)
        try:
            found = shifts(ledger, wanted, begins, now, given.ideal_cycle_s)
            told = [*ledger.faults(replace(wanted, fault="")), *ledger.not_inserted(wanted)]
            reasons = tuple(sorted(told, key=lambda reason: -reason[1]))
            newest = found[-1] if found else None
            is_planned = "shifts" in given.model_fields_set
            return ShiftFigures(ledger.count(wanted), newest, reasons, is_planned)
        finally:
            ledger.close()
    except LedgerError as error:
        _LOG.info("%s", error)
        return None
