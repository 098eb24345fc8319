"""Entries of the ledger: one per cycle."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter

from cell.files.input_error import InputError
from cell.files.plain import plain
from cell.files.text_file import known_json
from cell.records.folder import cycle_of, read_model, read_result, started_of
from cell.records.result import Outcome, Result

#: States in which the cell works on a cable; in the others it waits for a person or the line.
RUNNING = frozenset({"resetting", "starting", "execute", "completing", "complete"})


class LedgerError(Exception):
    """The ledger cannot be used.  Scenario: the plant's database server is being updated."""


@dataclass(frozen=True)
class LedgerEstimate:
    """A parameter of a cable, with its 95 % interval; None = not known.  SI units."""

    name: str
    value: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Acknowledgement:
    """A person's acknowledgement of a fault; `at` with a time zone."""

    at: datetime
    by: str
    note: str = ""


@dataclass(frozen=True)
class LedgerEntry:
    """A cycle that has begun, or has ended.

    line         that the cell belongs to
    part         id of the cable; None = it has none
    product      of the cable; None = the settings have no products
    aim          intended outcome
    result       None = it has not ended yet
    calibration  hash of the calibration's files; None = as typed
    software     version of this program
    acknowledged   acknowledgement of its fault; None = not yet
    waited       s since the previous cycle, by reason: `start`, `downstream`, `acknowledgement`, …
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    line: str
    cycle: int
    folder: Path
    started: datetime
    aim: str
    part: str | None = None
    product: str | None = None
    ended: datetime | None = None
    result: Result | None = None
    estimates: tuple[LedgerEstimate, ...] = ()
    calibration: str | None = None
    software: str | None = None
    acknowledged: Acknowledgement | None = None
    waited: Mapping[str, float] = field(default_factory=dict)

    @property
    def uid(self) -> str:
        """Identifier of this cycle, independent of the place of its folder."""
        return f"{self.line}/{self.folder.name}"

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return plain(_adapter().dump_python(self, mode="json"))  # type: ignore[no-any-return]

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> LedgerEntry:
        """Back from `to_json`; older versions had fewer entries.  Raises ValueError: none."""
        return _adapter().validate_json(json.dumps(data), strict=True)


@cache
def _adapter() -> TypeAdapter[LedgerEntry]:
    return TypeAdapter(LedgerEntry)


def estimates_of(model: Mapping[str, Any] | None) -> tuple[LedgerEstimate, ...]:
    """Parameters of the content of a `model.json`; none if it is None."""
    listed: Sequence[Mapping[str, Any]] = () if model is None else model["parameters"]
    return tuple(LedgerEstimate(p["name"], p["value"], p.get("low"), p.get("high")) for p in listed)


def entry_of_folder(folder: Path, line: str) -> LedgerEntry | None:
    """Ledger entry of a cycle's folder; None = it is not a cycle's folder, or is unreadable."""
    cycle, state = cycle_of(folder), known_json(folder / "state.json")
    if cycle is None:
        return None
    try:
        known, estimates = read_result(folder), estimates_of(read_model(folder))
        ended = (folder / "result.json").stat().st_mtime if known is not None else None
    except (OSError, InputError):
        return None
    aim = Outcome.INSERTED
    if known is not None and known.outcome in (Outcome.MEASURED, Outcome.REHEARSED, Outcome.UNFIT):
        aim = known.outcome
    return LedgerEntry(
        line,
        cycle,
        folder.absolute(),
        started_of(folder, state).astimezone(UTC),
        aim.value,
        None if known is None else known.part,
        state.get("product") if known is None else known.product,
        None if ended is None else datetime.fromtimestamp(ended, UTC),
        known,
        estimates,
    )
