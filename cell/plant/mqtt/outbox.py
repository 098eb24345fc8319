"""Queue of notices for a broker: a file next to the records, which outlives the adapter.

A notice is written with its place in the order of the cell in one transaction, before its
delivery.  It is removed when the broker has acknowledged it.
"""

from __future__ import annotations

import json
import logging
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from cell.plant.messages import MessageKind, Notice

_LOG = logging.getLogger(__name__)

#: Kinds that are dropped, in this order, when too many wait; never results.
_DROPPED = (
    (
        MessageKind.STATE,
        MessageKind.STEP,
        MessageKind.WAITING,
        MessageKind.CYCLE,
        MessageKind.PRODUCT,
        MessageKind.ADAPTER,
    ),
    (MessageKind.ACKNOWLEDGED, MessageKind.FAULT),
)
#: Share of the queue's limit that is dropped at once.
_DROPPED_SHARE = 0.01

_TABLES = """
CREATE TABLE IF NOT EXISTS waiting (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    run TEXT NOT NULL, sequence INTEGER NOT NULL, time_s REAL NOT NULL,
    kind TEXT NOT NULL, data TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS waiting_kind ON waiting (kind, number);
CREATE TABLE IF NOT EXISTS taken (
    one INTEGER PRIMARY KEY CHECK (one = 1), run TEXT NOT NULL, sequence INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS counters (name TEXT PRIMARY KEY, value INTEGER NOT NULL);
"""


class OutboxError(OSError):
    """The file of the outbox cannot be used.  Scenario: another adapter uses it."""


@dataclass(frozen=True)
class Waiting:
    """A queued notice.

    number  in the outbox, unique even after removals
    """

    number: int
    notice: Notice


def outbox_of(runs: Path) -> Path:
    """File of the outbox of a cell whose records are in the folder `runs`."""
    folder = runs.resolve()
    return folder.with_name(f"{folder.name}.mqtt.sqlite")


class MqttOutbox:
    """Queue of notices; safe to be used from several threads of one process.

    path  of the file, which is made if it is missing
    most  limit of the queue; beyond it the oldest notices that are not results are dropped

    raises  OutboxError, here and from every method: another adapter has it, or the disk is full
    """

    def __init__(self, path: Path, most: int) -> None:
        self._path = path
        self._most = most
        self._lock = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(
                path, timeout=0.0, isolation_level=None, check_same_thread=False
            )
            # the lock lasts until the end of the process, even after a crash
            self._database.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = FULL")
            self._database.execute("BEGIN EXCLUSIVE")  # lock it here, not at the first notice
            self._database.execute("COMMIT")
            self._database.executescript(_TABLES)
            self._count = self._counted()
        except (sqlite3.Error, OSError) as error:
            raise self._failed(error) from error

    @property
    def path(self) -> Path:
        """The file."""
        return self._path

    def put(self, notice: Notice) -> None:
        """Add a notice, as the newest one received from the cell."""
        data = json.dumps(notice.data, ensure_ascii=False)
        row = (notice.run, notice.sequence, notice.time_s, notice.kind.value, data)
        with self._writing():
            self._database.execute(
                "INSERT INTO waiting (run, sequence, time_s, kind, data) VALUES (?, ?, ?, ?, ?)",
                row,
            )
            self._database.execute("INSERT OR REPLACE INTO taken VALUES (1, ?, ?)", row[:2])
            self._count += 1
            if self._count > self._most:
                self._drop()

    def first(self) -> Waiting | None:
        """The oldest notice; None = none waits."""
        with self._reading():
            row = self._database.execute(
                "SELECT number, run, sequence, time_s, kind, data FROM waiting "
                "ORDER BY number LIMIT 1"
            ).fetchone()
        if row is None:
            return None
        number, run, sequence, time_s, kind, data = row
        return Waiting(number, Notice(run, sequence, time_s, MessageKind(kind), json.loads(data)))

    def remove(self, waiting: Waiting) -> None:
        """Remove a delivered notice."""
        with self._writing():
            removed = self._database.execute(
                "DELETE FROM waiting WHERE number = ?", (waiting.number,)
            )
            self._count -= removed.rowcount

    def newest(self) -> tuple[str, int] | None:
        """Run and sequence of the newest notice that was put; None = none yet."""
        with self._reading():
            row = self._database.execute("SELECT run, sequence FROM taken").fetchone()
        return None if row is None else (row[0], row[1])

    def start_after(self, position: tuple[str, int]) -> None:
        """Store this run and sequence as the newest: earlier notices are not available."""
        with self._writing():
            self._database.execute("INSERT OR REPLACE INTO taken VALUES (1, ?, ?)", position)

    def count(self) -> int:
        """Number of notices that wait."""
        with self._lock:
            return self._count

    def counter(self, name: str) -> int:
        """A persistent counter; 0 if it was never incremented."""
        with self._reading():
            row = self._database.execute(
                "SELECT value FROM counters WHERE name = ?", (name,)
            ).fetchone()
        return 0 if row is None else int(row[0])

    def count_up(self, name: str) -> int:
        """Increment a counter; returns its new value."""
        with self._writing():
            self._add(name, 1)
        return self.counter(name)

    def dropped(self) -> int:
        """Number of notices dropped so far."""
        return self.counter("dropped")

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._database.close()

    def _drop(self) -> None:
        """Remove the oldest droppable notices, some at a time."""
        most = max(1, round(_DROPPED_SHARE * self._most))
        for kinds in _DROPPED:
            marks = ", ".join("?" * len(kinds))
            removed = self._database.execute(
                "DELETE FROM waiting WHERE number IN (SELECT number FROM waiting "
                f"WHERE kind IN ({marks}) ORDER BY number LIMIT ?)",
                (*(kind.value for kind in kinds), most),
            ).rowcount
            if removed:
                self._count -= removed
                self._add("dropped", removed)
                _LOG.warning(
                    "%s: more than %d messages wait for the broker: the oldest %d that are not "
                    "results were dropped",
                    self._path,
                    self._most,
                    removed,
                )
                return

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Hold the lock of the file."""
        with self._lock:
            try:
                yield
            except sqlite3.Error as error:
                raise self._failed(error) from error

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Hold the lock of the file, in one transaction."""
        with self._reading():
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._database.execute("COMMIT")
            except sqlite3.Error:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                self._count = self._counted()
                raise

    def _counted(self) -> int:
        [(count,)] = self._database.execute("SELECT count(*) FROM waiting")
        return int(count)

    def _failed(self, error: Exception) -> OutboxError:
        if "locked" in str(error):
            return OutboxError(f"another adapter uses {self._path}; end it first")
        return OutboxError(
            f"{self._path}: {error}; make room on the disk, or move the file away if it is damaged"
        )

    def _add(self, name: str, more: int) -> None:
        self._database.execute(
            "INSERT INTO counters VALUES (?, ?) "
            "ON CONFLICT (name) DO UPDATE SET value = value + excluded.value",
            (name, more),
        )
