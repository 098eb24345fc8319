"""What an earlier service has left: its newest cycle, and a mark where no record tells."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from cell.plant.messages import FaultNotice
from cell.records.folder import read_record
from cell.records.past_cycles import cycle_of
from cell.records.result import Outcome


@dataclass(frozen=True)
class Earlier:
    """The newest cycle of a folder of records: its folder, number, and fault if one is open."""

    folder: Path
    cycle: int
    fault: FaultNotice | None


def earlier_cycle(runs: Path) -> Earlier | None:
    """The newest cycle in a folder, None = there is none.

    Its fault is open if it was never concluded, or failed, and nobody has acknowledged that.
    raises  InputError: its files were changed and are wrong now
    """
    folders = [f for f in runs.iterdir() if cycle_of(f)] if runs.is_dir() else []
    if not folders:
        return None
    folder = max(folders, key=lambda f: cycle_of(f) or ())
    found = cycle_of(folder)
    assert found is not None
    number = found[1]
    if not (folder / "state.json").exists():
        return Earlier(folder, number, _unfinished(folder, number, ""))
    record = read_record(folder)
    if "acknowledged" in record.state:
        return Earlier(folder, number, None)
    if not record.closed or record.result is None:
        return Earlier(folder, number, _unfinished(folder, number, record.step or ""))
    fault = record.result.fault
    if record.result.outcome is not Outcome.FAILED or fault is None:
        return Earlier(folder, number, None)
    return Earlier(folder, number, FaultNotice(number, time_s=time.time(), **vars(fault)))


def _unfinished(folder: Path, number: int, step: str) -> FaultNotice:
    return FaultNotice(
        number,
        step,
        f"cycle {number} was not finished: the program or the computer ended within it",
        time.time(),
        remedy="look where the hand and the cable are, then reset",
        cable=f"not known; see {folder}",
        code="unfinished",
    )


class Mark:
    """A file that lets the next service wait for a person, where no record does.

    It is there while the hand may be moving outside a cycle, and after a stop in Idle.
    """

    def __init__(self, runs: Path) -> None:
        self.file = runs.with_name(f"{runs.name}.unsettled")

    def leave(self, cause: str) -> None:
        """Write it; a full disk is told when the record is begun."""
        with suppress(OSError):
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self.file.write_text(cause, encoding="utf-8")

    def remove(self) -> None:
        """There is nothing to be looked at any more."""
        with suppress(OSError):
            self.file.unlink(missing_ok=True)

    def fault(self, number: int) -> FaultNotice | None:
        """What it says, of the cycle that would have been next; None = it is not there."""
        if not self.file.exists():
            return None
        try:
            cause = self.file.read_text(encoding="utf-8")
        except OSError:
            cause = ""
        return FaultNotice(
            number,
            "reset",
            cause or "the service before has ended",
            time.time(),
            remedy="look where the hand is and what the jaws hold, then reset",
            code="unfinished",
        )
