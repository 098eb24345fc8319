"""Actions of people at the pages, copied into the ledger from the log of actions.

The log, lines of JSON, is written first; they are copied later if the ledger is not reachable.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, func, insert, select

from cell.records.ledger.database import database_errors, opened, writing
from cell.records.ledger.tables import actions

#: Number of lines that are copied in one transaction.
_MOST = 1000


@dataclass(frozen=True)
class Action:
    """One action.

    by    user who did it, or tried to
    done  whether it was allowed and accepted
    """

    at: datetime
    by: str
    action: str
    done: bool
    note: str
    line: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return vars(self) | {"at": self.at.isoformat()}


def take_over(ledger: str | Path, log: Path, line: str) -> int:
    """Copy new lines of a log of actions into the ledger; returns how many.

    ledger  as of `Ledger`
    line    that the cell belongs to
    raises  LedgerError; OSError: the log cannot be read
    """
    if not log.exists():
        return 0
    with opened(ledger) as engine, writing(engine) as connection:
        source, after = _last_copied(connection, log)
        rows = _rows(log, after)
        if rows:
            common = {"source": source, "line": line}
            connection.execute(insert(actions), [common | row for row in rows])
    return len(rows)


def listed_actions(
    ledger: str | Path, since: datetime | None = None, most: int | None = None
) -> list[Action]:
    """Actions since a time, oldest first, at most the newest `most`.  Raises LedgerError."""
    query = select(actions).order_by(actions.c.at.desc(), actions.c.id.desc())
    if since is not None:
        query = query.where(actions.c.at >= since.astimezone(UTC).replace(tzinfo=None))
    with opened(ledger) as engine, database_errors(engine), engine.connect() as connection:
        rows: Sequence[Any] = connection.execute(query.limit(most)).all()[::-1]
    return [
        Action(r.at.replace(tzinfo=UTC).astimezone(), r.by, r.action, r.done, r.note, r.line)
        for r in rows
    ]


def _last_copied(connection: Connection, log: Path) -> tuple[str, int | None]:
    """Name of a log in the ledger, and place of its newest line there; None = there is none.

    A new log, after the former one was moved away, is a different source: sources are identified
    by the time of their first line.
    """
    source = f"{platform.node()}:{log.resolve()}"[-300:]
    newest = select(actions).where(actions.c.source == source).order_by(actions.c.place.desc())
    known = connection.execute(newest.limit(1)).first()
    if known is None:
        return source, None
    with log.open("rb") as file:
        first = _row(file.readline())
        file.seek(known.place)
        there = _row(file.readline())
    if first is None or (there is not None and there == {k: getattr(known, k) for k in there}):
        return source, known.place
    source = f"{source} from {first['at'].isoformat()}"[-300:]
    of_it = select(func.max(actions.c.place)).where(actions.c.source == source)
    return source, connection.scalar(of_it)


def _rows(log: Path, after: int | None) -> list[dict[str, Any]]:
    """Complete lines after the one at a place in the file; `place`: offset of a line."""
    rows: list[dict[str, Any]] = []
    with log.open("rb") as file:
        if after is not None:
            file.seek(after)
            file.readline()
        while len(rows) < _MOST:
            place, text = file.tell(), file.readline()
            if not text.endswith(b"\n"):
                return rows
            if (row := _row(text)) is not None:
                rows.append({"place": place, **row})
    return rows


def _row(text: bytes) -> dict[str, Any] | None:
    """A line of the log; None = it is not valid, as after a power cut."""
    try:
        entry = json.loads(text)
        at = datetime.fromisoformat(entry["at"]).astimezone(UTC).replace(tzinfo=None)
        by, action = str(entry["by"])[:100], str(entry["action"])[:100]
        return {
            "at": at, "by": by, "action": action, "done": bool(entry["done"]),
            "note": str(entry["note"]),
        }  # fmt: skip
    except (ValueError, KeyError, TypeError):
        return None
