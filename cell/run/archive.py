"""Where the evidence of cycles goes: recordings frame by frame, and a ledger that lists them."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace

from cell.run.listed import LedgerSetup
from cell.run.product import ProductTask
from cell.run.recorded import RecordingSetup


@dataclass(frozen=True)
class Archive:
    """How cycles are recorded and listed; None = they are not."""

    recording: RecordingSetup | None = None
    ledger: LedgerSetup | None = None

    def recording_of(self, made: ProductTask) -> RecordingSetup | None:
        """How cycles of a product are recorded: with its settings and files."""
        if self.recording is None:
            return None
        return replace(self.recording, settings=made.settings, files=made.files)

    def ledger_of(self, made: ProductTask) -> LedgerSetup | None:
        """To which ledger cycles of a product are told: with its calibration."""
        return None if self.ledger is None else replace(self.ledger, calibration=made.calibration)

    def notes(self) -> tuple[str, ...]:
        """What a person should know of them."""
        recorded = () if self.recording is None else self.recording.notes()
        return (*recorded, *([] if self.ledger is None else self.ledger.ledger.notes))

    def close(self) -> None:
        """Nothing more comes."""
        with ExitStack() as stack:
            if self.ledger is not None:
                stack.callback(self.ledger.ledger.close)
            if self.recording is not None:
                stack.callback(self.recording.close)
