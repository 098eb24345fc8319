"""Brings recordings to a store while no cable is in the jaws, and then removes them here."""

from __future__ import annotations

import fcntl
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

from cell.records.recording import form
from cell.records.recording.retention import KEPT
from cell.records.recording.store import RecordingStoreError, Store, Stored, Turn, mark, name_of
from drivers.threads import GuardedThread, error_text

_LOG = logging.getLogger(__name__)

#: First delay before a retry after a failure, s; it grows.
_FIRST_S, _LAST_S = 2.0, 120.0
#: Longest wait of the gripper before gripping for the block in transfer, s …
HOLD_S = 2.0
#: … and the end of a run for the recordings that are not uploaded yet.
CLOSE_S = 60.0
#: Polling interval for a recording that its recorder has yet to finish, s.
_LOOK_S = 0.1


class _NotNowError(RecordingStoreError):
    """A run ends while a cable is in the jaws."""


def waiting(runs: Path) -> list[Path]:
    """Recordings in `runs` that are not uploaded yet, oldest first."""
    files = runs.glob(f"*/{form.FILE}") if runs.is_dir() else ()
    return sorted(p for p in files if not p.with_name(form.STORED).exists())


def bring(store: Store, recording: Path, line: str, turn: Turn) -> Stored | None:
    """Upload a recording, verify it, then remove the local one unless it is protected.

    returns  None = a different process uploads it, or has done so
    raises   RecordingStoreError: it stays here; OSError
    """
    try:
        file = recording.open("rb")
    except FileNotFoundError:
        return None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return None
        if not recording.exists():  # the other has just done it
            return None
        stored = store.put(recording, name_of(recording, line), turn)
        mark(recording.parent, stored)
        if not recording.with_name(KEPT).exists():
            recording.unlink()
    _LOG.info("%s is in %s, verified", recording, stored.url)
    return stored


class Uploads:
    """Uploads recordings in a thread, between two cables.

    open_store  opens it, in the thread
    runs        folder of the records: pending recordings of earlier runs are uploaded too
    line        that the cell belongs to
    notes       messages for a person
    """

    def __init__(self, open_store: Callable[[], Store], runs: Path, line: str) -> None:
        self.notes: list[str] = []
        self._open_store = open_store
        self._runs, self._line = runs, line

        self._new: deque[Path] = deque()
        self._wake = threading.Event()
        self._over = threading.Event()
        self._empty = threading.Event()  # the jaws
        self._block = threading.Lock()
        self._remaining = 0
        self._failed = ""
        self._thread = GuardedThread("uploads", self._run, self._died)

    def start(self) -> None:
        """Begin, with pending recordings; nothing is sent before the jaws are empty."""
        self._thread.start()

    def add(self, recording: Path) -> None:
        """Register a recording that has ended: it becomes a file soon."""
        self._new.append(recording)
        self._wake.set()

    def jaws(self, *, holding: bool) -> None:
        """Report whether the jaws hold a cable or are about to.  No block is in transfer when this
        returns, unless the store needs longer than `HOLD_S` for it.
        """
        if not holding:
            self._empty.set()
            return
        if not self._empty.is_set():
            return
        self._empty.clear()
        if self._block.acquire(timeout=HOLD_S):
            self._block.release()
        else:
            _LOG.warning("uploads: the store is slow: a block is sent while a cable is gripped")

    def close(self) -> None:
        """Upload the rest if no cable is in the jaws, with a time limit."""
        if not self._thread.is_alive():
            return
        self._over.set()
        self._wake.set()
        self._thread.join(CLOSE_S if self._empty.is_set() else HOLD_S)
        if self._remaining or self._thread.is_alive():
            why = self._failed or "there was no time"
            if not self._empty.is_set():
                why = "a cable is in the jaws"
            number = max(self._remaining, 1)
            self.notes.append(
                f"recordings in {self._runs} that are not uploaded yet: {number}: {why}; the next "
                "run or `cell upload` does it"
            )

    # --- its thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        pending = deque(waiting(self._runs))
        pause_s = _FIRST_S
        while True:
            over = self._over.is_set()
            unfinished = self._take_new(pending)
            self._remaining = len(pending)
            if not pending:
                if over:
                    return
                self._wake.wait(_LOOK_S if unfinished else None)
                self._wake.clear()
                continue
            try:
                bring(self._store, pending[0], self._line, self._turn)
            except _NotNowError:
                return
            except (RecordingStoreError, OSError) as error:
                if not self._failed:
                    _LOG.warning("uploads: %s: recordings stay here until it is there", error)
                pause_s = min(_LAST_S, 2.0 * pause_s) if self._failed else _FIRST_S
                self._failed = str(error)
                pending.rotate(-1)  # it may be this one alone
                if self._over.is_set():
                    return
                self._over.wait(pause_s)
            else:
                pending.popleft()
                self._failed = ""

    def _died(self, error: BaseException) -> None:
        self.notes.append(
            f"recordings in {self._runs} are uploaded no more: {error_text(error)}; the next run "
            "or `cell upload` does it"
        )

    @cached_property
    def _store(self) -> Store:
        return self._open_store()

    def _take_new(self, pending: deque[Path]) -> bool:
        """Queue recordings that are files by now; whether some are unfinished or torn."""
        for _ in range(len(self._new)):
            path = self._new.popleft()
            (pending if path.exists() else self._new).append(path)
        return bool(self._new)

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """Context of a transfer: entered only while the jaws are empty."""
        while True:
            while not self._empty.wait(_LOOK_S):
                over = self._over.is_set()  # checked first: jaws are emptied before
                if over and not self._empty.is_set():
                    raise _NotNowError("a run ends while a cable is in the jaws")
            with self._block:
                if self._empty.is_set():
                    yield
                    return
