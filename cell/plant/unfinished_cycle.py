"""State that an earlier service has left: cycles with open faults, or a flag file instead."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError
from cell.files.text_file import read_json_object
from cell.plant.messages import FaultNotice
from cell.records.folder import cycle_of, read_record, started_of
from cell.records.result import Outcome

#: Other open cycles that a fault names.
_NAMED = 3


@dataclass(frozen=True)
class EarlierCycles:
    """Summary of the cycles in a folder of records.

    cycle  the highest number among them; 0 = there are none
    open   folders of those that a person has to look at, the newest last
    fault  of the newest of these
    """

    cycle: int = 0
    open: tuple[Path, ...] = ()
    fault: FaultNotice | None = None


def earlier_cycles(runs: Path) -> EarlierCycles:
    """Find the highest cycle number and the open cycles in a folder of records.

    One is open if it was never concluded, or failed, and nobody has acknowledged that: whenever it
    was, since a clock may have been set back and a folder may come from elsewhere.
    """
    folders = [f for f in runs.iterdir() if cycle_of(f) is not None] if runs.is_dir() else []
    found = []
    for folder in folders:
        state = _state(folder)
        if (fault := _open_fault(folder, state)) is not None:
            found.append((started_of(folder, state), folder.name, fault))
    found.sort(key=lambda each: each[:2])
    return EarlierCycles(
        max((cycle_of(f) or 0 for f in folders), default=0),
        tuple(runs / name for _, name, _ in found),
        _newest_naming_others([fault for *_, fault in found]),
    )


def _state(folder: Path) -> Mapping[str, Any]:
    """State of a cycle; empty = there is none, or it cannot be read."""
    try:
        return read_json_object(folder / "state.json")
    except InputError:
        return {}


def _open_fault(folder: Path, state: Mapping[str, Any]) -> FaultNotice | None:
    """Why a person has to look at a cycle; None = that is not so, or was done."""
    ended = state.get("outcome")
    if "acknowledged" in state:
        return None
    if state.get("closed") is True and ended in set(Outcome) - {Outcome.FAILED}:
        return None
    number, step = cycle_of(folder) or 0, str(state.get("step") or "")
    try:
        record = read_record(folder)
    except InputError:
        return _unfinished(folder, number, step, readable=not (folder / "state.json").exists())
    if not record.closed or record.result is None:
        return _unfinished(folder, number, step)
    fault = record.result.fault
    if record.result.outcome is not Outcome.FAILED or fault is None:
        return None
    return FaultNotice(number, time_s=time.time(), **vars(fault))


def _unfinished(folder: Path, number: int, step: str, *, readable: bool = True) -> FaultNotice:
    if readable:
        cause = f"cycle {number} was not finished: the program or the computer ended within it"
    else:
        cause = f"the files of cycle {number} cannot be read: nobody knows how it ended"
    return FaultNotice(
        number,
        step,
        cause,
        time.time(),
        remedy="look where the gripper and the cable are, then reset",
        cable=f"not known; see {folder}",
        code="unfinished",
    )


def _newest_naming_others(faults: list[FaultNotice]) -> FaultNotice | None:
    """The newest fault, which names the others; None = there are none."""
    if len(faults) < 2:
        return faults[0] if faults else None
    *others, newest = faults
    named = ", ".join(str(fault.cycle) for fault in others[: -_NAMED - 1 : -1])
    more = len(others) - _NAMED
    cycles = named if more <= 0 else f"{named}, … ({len(others)})"
    cause = f"{newest.cause}; not acknowledged either: cycles {cycles}"
    return FaultNotice(cause=cause, **{k: v for k, v in vars(newest).items() if k != "cause"})


class AcknowledgementFlag:
    """File that makes the next service wait for a person, where no record does.

    It is there while the gripper may be moving outside a cycle, and after a stop in Idle.
    """

    def __init__(self, runs: Path) -> None:
        self.file = runs.with_name(f"{runs.name}.unsettled")

    def write(self, cause: str) -> None:
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
            remedy="look where the gripper is and what the jaws hold, then reset",
            code="unfinished",
        )
