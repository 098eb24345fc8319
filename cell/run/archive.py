"""Where the evidence of cycles goes: recordings frame by frame, and a ledger that lists them."""

from __future__ import annotations

from dataclasses import dataclass

from cell.run.listed import LedgerSetup
from cell.run.recorded import RecordingSetup


@dataclass(frozen=True)
class Archive:
    """How cycles are recorded and listed; None = they are not."""

    recording: RecordingSetup | None = None
    ledger: LedgerSetup | None = None

    def notes(self) -> tuple[str, ...]:
        """What a person should know of them."""
        recorded = () if self.recording is None else self.recording.notes()
        return (*recorded, *([] if self.ledger is None else self.ledger.ledger.notes))

    def close(self) -> None:
        """Nothing more comes."""
        if self.recording is not None:
            self.recording.close()
        if self.ledger is not None:
            self.ledger.ledger.close()
