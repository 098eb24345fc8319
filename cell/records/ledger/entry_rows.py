"""Converts entries to rows of the ledger's tables."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select, update

from cell.records.ledger.entry import RUNNING, Acknowledgement, LedgerEntry
from cell.records.ledger.tables import (
    LONGEST_NAME,
    NUMBERS,
    acknowledgements,
    cycles,
    faults,
    parameters,
    parts,
    times,
)


def write_entry(connection: Connection, entry: LedgerEntry, of_now: bool) -> None:
    """Insert an entry, or update its changes; arguments as of `Ledger.write`."""
    known = connection.execute(
        select(cycles.c.id, cycles.c.outcome, cycles.c.ordered).where(cycles.c.uid == entry.uid)
    ).first()
    if known is not None and (known.outcome is not None or entry.result is None):
        if entry.acknowledged is not None:
            acknowledge_cycle(connection, known.id, entry.acknowledged)
            return
        if known.outcome is not None and entry.result is None:
            return
    values = _row(entry) | {"part_id": _part(connection, entry.part)}
    if known is None:
        values["ordered"] = _order_time(connection, entry) if of_now else utc(entry.started)
        number = connection.execute(insert(cycles).values(values)).inserted_primary_key
        assert number is not None
        at = number[0]
    else:
        at = known.id
        connection.execute(update(cycles).where(cycles.c.id == at).values(values))
        for of_cycle in (parameters, faults, times):
            connection.execute(delete(of_cycle).where(of_cycle.c.cycle_id == at))
    rows: dict[Any, list[dict[str, Any]]] = {
        parameters: [vars(e) for e in entry.estimates],
        faults: [],
        times: [],
    }
    if entry.result is not None:
        fault = entry.result.fault
        rows[faults] = [] if fault is None else [vars(fault)]
        rows[times] = [
            {"kind": kind, "name": name, "seconds": seconds}
            for kind, spent in (
                ("state", entry.result.state_seconds),
                ("step", entry.result.seconds),
                ("waiting", _short_names(entry.waited)),
            )
            for name, seconds in spent.items()
        ]
    for of_cycle, new in rows.items():
        if new:
            connection.execute(insert(of_cycle), [{"cycle_id": at, **row} for row in new])
    if entry.acknowledged is not None:
        acknowledge_cycle(connection, at, entry.acknowledged)


def acknowledge_cycle(connection: Connection, at: int, ack: Acknowledgement) -> None:
    """Write the acknowledgement of a cycle's fault; `at`: number of the cycle."""
    connection.execute(delete(acknowledgements).where(acknowledgements.c.cycle_id == at))
    row = {"cycle_id": at, "at": utc(ack.at), "by": ack.by, "note": ack.note}
    connection.execute(insert(acknowledgements), [row])


def _row(entry: LedgerEntry) -> dict[str, Any]:
    row: dict[str, Any] = {
        "uid": entry.uid,
        "line": entry.line,
        "cycle": entry.cycle,
        "folder": str(entry.folder),
        "aim": entry.aim,
        "product": entry.product,
        "started": utc(entry.started),
        "ended": None if entry.ended is None else utc(entry.ended),
        "calibration": entry.calibration,
        "software": entry.software,
        "model_misses": False,
    }
    result = entry.result
    if result is not None:
        row |= {name: getattr(result, name) for name in NUMBERS}
        row |= {
            "outcome": result.outcome.value,
            "reason": result.reason,
            "model": result.model,
            "model_misses": result.model_misses,
            "running_s": sum(s for state, s in result.state_seconds.items() if state in RUNNING),
        }
    return row


def _part(connection: Connection, code: str | None) -> int | None:
    """Number of a part, which is inserted if its id is new."""
    if code is None:
        return None
    part_id = connection.scalar(select(parts.c.id).where(parts.c.code == code))
    if part_id is None:
        number = connection.execute(insert(parts).values(code=code)).inserted_primary_key
        assert number is not None
        part_id = number[0]
    return int(part_id)


def _order_time(connection: Connection, entry: LedgerEntry) -> datetime:
    """When the cycle began, but not before the line's newest: a clock may have been set back."""
    started = utc(entry.started)
    newest = connection.scalar(
        select(func.max(cycles.c.ordered)).where(cycles.c.line == entry.line)
    )
    return started if newest is None else max(started, newest)


def _short_names(seconds: Mapping[str, float]) -> dict[str, float]:
    """Times by names that are cut to the table's width: a name may be a person's note."""
    shortened: dict[str, float] = {}
    for name, spent_s in seconds.items():
        short = name[:LONGEST_NAME]
        shortened[short] = shortened.get(short, 0.0) + spent_s
    return shortened


def utc(moment: datetime) -> datetime:
    """A time in UTC without a time zone, as the ledger's tables store it."""
    return moment.astimezone(UTC).replace(tzinfo=None)
