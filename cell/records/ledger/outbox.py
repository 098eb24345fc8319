"""Queue of entries for the ledger: files in a folder, which a thread writes to the ledger.

A cycle never waits for a database.  While a server is away, entries stay in the folder and are
written later, in their order; so are those of a program that was killed.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from cell.files.atomic import write_new
from cell.files.words import counted
from cell.records.ledger.entry import LedgerEntry, LedgerError
from drivers.threads import GuardedThread, error_text

if TYPE_CHECKING:
    from cell.records.ledger.ledger import Ledger

_LOG = logging.getLogger(__name__)

#: First delay before a retry after a failure, s; it grows.
_FIRST_S, _LAST_S = 1.0, 30.0
#: Longest wait of the end of a run for the ledger, s.
CLOSE_S = 10.0
#: Entries that are written in one transaction.
_TOGETHER = 100


def outbox_of(runs: Path) -> Path:
    """Folder of the queue, next to a folder of records."""
    return runs.with_name(f"{runs.name}.outbox")


class Outbox:
    """Queue of entries, each a file; the oldest first."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, entry: LedgerEntry) -> None:
        """Add one.  Raises OSError: it cannot be written."""
        content = json.dumps(entry.to_json(), ensure_ascii=False)
        while True:
            self._folder.mkdir(parents=True, exist_ok=True)
            number = 1 + max((_number(f) for f in self._files()), default=0)
            # the file may exist, from another cell that uses this folder; or the folder is gone,
            # because another process has just written its last entry
            with suppress(FileExistsError, FileNotFoundError):
                write_new(self._folder / f"{number:08d}-{os.getpid()}.json", content)
                return

    def waiting(self, most: int) -> list[tuple[Path, LedgerEntry]]:
        """The oldest entries, at most `most`, and their files.

        An entry that cannot be read is renamed to `.bad`.
        """
        entries = []
        for file in self._files()[:most]:
            try:
                entries.append((file, LedgerEntry.from_json(json.loads(file.read_text("utf-8")))))
            except FileNotFoundError:  # another cell has just written it
                continue
            except ValueError as error:
                _LOG.error("%s is no entry of a ledger: %s: it is put aside", file, error)
                with suppress(OSError):
                    file.rename(file.with_suffix(".bad"))
        return entries

    def count(self) -> int:
        """Number of entries."""
        return len(self._files())

    def remove(self, file: Path) -> None:
        """Remove a written entry, and the folder with the last one."""
        file.unlink(missing_ok=True)
        with suppress(OSError):
            self._folder.rmdir()

    def _files(self) -> list[Path]:
        return sorted(self._folder.glob("*.json"), key=lambda f: (_number(f), f.name))


def _number(file: Path) -> int:
    digits = file.name.split("-")[0]
    return int(digits) if digits.isdigit() else 0


class LaterLedger:
    """A ledger that is opened, and created if it is missing, at the first write."""

    def __init__(self, place: str | Path) -> None:
        self._place = place
        self._ledger: Ledger | None = None

    def write(self, entries: Sequence[LedgerEntry]) -> None:
        """Write entries, all or none.  Raises LedgerError."""
        from cell.records.ledger.ledger import Ledger  # a third of a second, in the writer's thread

        if self._ledger is None:
            self._ledger = Ledger(self._place, create=True)
        self._ledger.write(entries)

    def close(self) -> None:
        """Close its connections."""
        if self._ledger is not None:
            self._ledger.close()


class LedgerWriter:
    """Hands entries to a ledger, in a thread of its own.

    ledger  is written to, and closed at the end
    outbox  folder of pending entries
    notes   messages for a person
    """

    def __init__(self, ledger: LaterLedger, outbox: Path) -> None:
        self.notes: list[str] = []
        self._ledger = ledger
        self._outbox = Outbox(outbox)
        self._place = outbox
        self._wake = threading.Event()
        self._over = threading.Event()
        self._failed = ""
        self._thread = GuardedThread("ledger", self._run, self._died)

    def start(self) -> None:
        """Begin, with pending entries of an earlier run."""
        self._thread.start()
        self._wake.set()

    def put(self, entry: LedgerEntry) -> None:
        """Hand over an entry."""
        try:
            self._outbox.put(entry)
        except OSError as error:
            self._note(
                f"the ledger lacks {entry.folder.name}: {error.strerror or error}; take it in "
                f"with `cell history --import {entry.folder.parent}`"
            )
        self._wake.set()

    def close(self) -> None:
        """Try once more, and end."""
        if not self._thread.is_alive():
            return
        self._over.set()
        self._wake.set()
        self._thread.join(CLOSE_S)
        waiting = self._outbox.count()
        if waiting:
            self._note(
                f"{counted(waiting, 'entry', 'entries')} for the ledger in {self._place}: "
                f"{self._failed or 'it is slow'}; written by the next run that can"
            )

    def _run(self) -> None:
        pause_s = _FIRST_S
        while True:
            self._wake.wait(pause_s if self._failed else None)
            self._wake.clear()
            over = self._over.is_set()
            try:
                self._write_waiting()
            except (LedgerError, OSError) as error:
                if not self._failed:
                    _LOG.warning("ledger: %s: the cell goes on, and writes to it later", error)
                pause_s = min(_LAST_S, 2.0 * pause_s) if self._failed else _FIRST_S
                self._failed = str(error)
            else:
                if self._failed:
                    _LOG.warning("ledger: it is there again, and has got what waited")
                self._failed = ""
            if over:
                self._ledger.close()
                return

    def _died(self, error: BaseException) -> None:
        self._note(
            f"entries wait in {self._place}, none is written any more: {error_text(error)}; the "
            "next run writes them"
        )

    def _write_waiting(self) -> None:
        while waiting := self._outbox.waiting(_TOGETHER):
            self._ledger.write([entry for _, entry in waiting])
            for file, _ in waiting:
                self._outbox.remove(file)

    def _note(self, note: str) -> None:
        _LOG.warning("ledger: %s", note)
        self.notes.append(note)
