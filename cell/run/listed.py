"""What of a cycle the ledger is told."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from cell.identify.identified import Identified
from cell.records.ledger.entry import Acknowledgement, LedgerEntry, entry_of_folder, estimates_of
from cell.records.result import Result


class TakesEntries(Protocol):
    """Hands entries to a ledger, without making anybody wait.

    notes  what a person should know
    """

    notes: list[str]

    def put(self, entry: LedgerEntry) -> None:
        """Hand over an entry."""

    def close(self) -> None:
        """Nothing more comes."""


@dataclass(frozen=True)
class LedgerSetup:
    """To which ledger a cell's cycles are told, and as what.

    line         that the cell belongs to
    calibration  hash of its files; None = as typed
    software     version of this program
    """

    ledger: TakesEntries
    line: str
    calibration: str | None = None
    software: str | None = None


class CycleListing:
    """Tells the ledger that a cycle has begun, and how it has ended; or nothing without one."""

    def __init__(self, setup: LedgerSetup | None) -> None:
        self._setup = setup
        self._entry: LedgerEntry | None = None

    def begin(
        self,
        folder: Path,
        cycle: int,
        started: datetime,
        aim: str,
        part: str | None,
        product: str | None = None,
    ) -> None:
        """The cycle begins."""
        if self._setup is None:
            return
        self._entry = LedgerEntry(
            line=self._setup.line,
            cycle=cycle,
            folder=folder.absolute(),
            started=started.astimezone(UTC),
            aim=aim,
            part=part,
            product=product,
            calibration=self._setup.calibration,
            software=self._setup.software,
        )
        self._setup.ledger.put(self._entry)

    def take_up(self, folder: Path) -> None:
        """It is the cycle of an earlier run that left this folder, and was not concluded."""
        if self._setup is not None:
            self._entry = entry_of_folder(folder, self._setup.line)

    def acknowledge(self, by: str, note: str) -> None:
        """A person says that the cycle's fault was looked at."""
        self._put(Acknowledgement(datetime.now(UTC), by, note))

    def reset(self, by: str, note: str) -> None:
        """A person has the cell reset after that: part of the acknowledgement's note."""
        said = None if self._entry is None else self._entry.acknowledged
        if said is not None:
            words = ": ".join(filter(None, (f"reset by {by}", note)))
            self._put(replace(said, note="; ".join(filter(None, (said.note, words)))))

    def _put(self, said: Acknowledgement) -> None:
        if self._setup is not None and self._entry is not None:
            self._entry = replace(self._entry, acknowledged=said)
            self._setup.ledger.put(self._entry)

    def end(self, result: Result, identified: Identified | None) -> None:
        """The cycle has ended; None = its cable was not identified."""
        if self._setup is None or self._entry is None:
            return
        self._entry = replace(
            self._entry,
            ended=datetime.now(UTC),
            result=result,
            estimates=estimates_of(None if identified is None else identified.to_dict()),
        )
        self._setup.ledger.put(self._entry)
