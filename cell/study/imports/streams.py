"""Records of several sources in one document, told apart: topics, nested clocks, and trials."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cell.study.imports.capture import CapturedColumn
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import HAND
from cell.study.imports.documents import cells, read_document
from cell.study.imports.groups import Tree
from cell.study.imports.units import METRES, RADIANS, unit_of

#: A source's words are few, and it has places or angles of its own.
_MOST_SOURCES = 20
_MEASURED = (ColumnKind.COORDINATE, ColumnKind.ANGLE, ColumnKind.QUATERNION)
#: Words of events that frame a trial.
_BEGINS = frozenset(("start", "begin", "started", "begun"))
_ENDS = frozenset(("stop", "end", "stopped", "ended", "finish", "finished"))
#: What a record of several clocks is called without its parts that have one of their own.
_RECORDS = "records"

Row = dict[CapturedColumn, float | str]


@dataclass(frozen=True)
class TrialWindow:
    """A trial between two events, in the unit of their times."""

    name: str
    begins: float
    ends: float


def streams_tree(path: Path) -> tuple[Tree, dict[tuple[str, ...], str]]:
    """Series by trial, source and name, in the order of their times; empty = one source alone.

    Topics without events between them, whose times rise in all, remain one table.

    raises  InputError: the document is damaged
    """
    parts: dict[str, list[Row]] = {}
    for _, record in read_document(path).records:
        for source, part in _by_clock(record).items():
            parts.setdefault(source, []).append(dict(cells(part)))
    one = next(iter(parts.values()), []) if len(parts) < 2 else []
    parts = parts if len(parts) > 1 else _by_source(one)
    windows = [w for rows in parts.values() for w in _windows(rows)]
    if len(parts) < 2 or (one and not windows and _in_order(one)):
        return {}, {}  # it is a table of all
    tree: Tree = {}
    units: dict[tuple[str, ...], str] = {}
    for window in (*windows,) or (None,):
        for source, rows in parts.items():
            key = (source,) if window is None else (window.name, source)
            for column, values in _series(rows, window).items():
                tree[*key, column.name] = values
                units[*key, column.name] = column.unit
    return tree, units


def _by_clock(record: Any) -> dict[str, Any]:
    """A record without the parts of what holds the cable that have another time, and these."""
    if not isinstance(record, Mapping) or (own := _time_of(record)) is None:
        return {_RECORDS: record}
    apart = {
        key: part for key, part in record.items()
        if HAND.intersection(re.findall("[a-z]+", str(key).lower()))
        and isinstance(part, Mapping) and _time_of(part) not in (None, own)
    }  # fmt: skip
    return {_RECORDS: {k: v for k, v in record.items() if k not in apart}} | apart


def _time_of(record: Mapping[str, Any]) -> float | None:
    of_kind = (k for k in record if _kind(CapturedColumn(str(k))) is ColumnKind.TIME)
    return next((record[k] for k in of_kind if isinstance(record[k], int | float)), None)


def _by_source(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by the word whose values have no measured column in common; else all together."""
    words = {c for c, value in rows[0].items() if isinstance(value, str)} if rows else set()
    for word in sorted(words, key=lambda c: c.name):
        found: dict[str, list[Row]] = {}
        for row in rows:
            found.setdefault(str(row.get(word, "")), []).append(row)
        if not 2 <= len(found) <= _MOST_SOURCES:
            continue
        columns = [{c for row in of for c in row if _is_measured(c)} for of in found.values()]
        if sum(map(bool, columns)) > 1 and len(set().union(*columns)) == sum(map(len, columns)):
            return {"_".join(re.findall(r"\w+", name)): of for name, of in found.items()}
    return {_RECORDS: list(rows)}


@cache
def _kind(column: CapturedColumn) -> ColumnKind:
    return meaning(column).kind


def _is_measured(column: CapturedColumn) -> bool:
    return _kind(column) in _MEASURED


def _time(rows: Sequence[Row]) -> CapturedColumn | None:
    columns = dict.fromkeys(c for row in rows for c, value in row.items() if value == value)
    return next((c for c in columns if _kind(c) is ColumnKind.TIME), None)


def _in_order(rows: Sequence[Row]) -> bool:
    time = _time(rows)
    times = [row[time] for row in rows if time is not None and isinstance(row.get(time), float)]
    return bool(np.all(np.diff(np.array(times, dtype=np.float64)) >= 0.0))


def _windows(rows: Sequence[Row]) -> list[TrialWindow]:
    """Trials between the events that begin and end them; named by a word of theirs."""
    time, found = _time(rows), list[TrialWindow]()
    begun_at: float | None = None
    if time is None or any(_is_measured(c) for row in rows for c in row):
        return []
    timed = (row for row in rows if isinstance(row.get(time), float))
    for row in sorted(timed, key=lambda row: float(row[time])):
        words = {c.name: v for c, v in row.items() if isinstance(v, str)}
        said = {v.lower() for v in words.values()}
        if said & _BEGINS:
            begun_at = float(row[time])
        elif said & _ENDS and begun_at is not None:
            trial = [v for n, v in words.items() if re.search(r"trial|run|test|name", n)]
            name = trial[0] if trial else f"trial_{len(found) + 1}"
            name += f"_{len(found) + 1}" if name in (window.name for window in found) else ""
            found.append(TrialWindow(name, begun_at, float(row[time])))
            begun_at = None
    return found


def _series(rows: Sequence[Row], window: TrialWindow | None) -> dict[CapturedColumn, np.ndarray]:
    """Columns of a source, in the order of its times within a trial; none where it has no time."""
    if (time := _time(rows)) is None:
        return {}
    kept = [row for row in rows if isinstance(row.get(time), float)]
    if window is not None:
        kept = [row for row in kept if window.begins <= float(row[time]) <= window.ends]
    kept.sort(key=lambda row: float(row[time]))
    columns = list(dict.fromkeys(c for row in kept for c in row))
    words = {c for c in columns if any(isinstance(row.get(c), str) for row in kept)}
    units = {unit_of(str(row[c])) for c in words if "unit" in c.name for row in kept if c in row}
    length, angle = (next(iter(units & set(known)), "") for known in (METRES, RADIANS))
    of_kind = {ColumnKind.COORDINATE: length, ColumnKind.ANGLE: angle}
    return {
        CapturedColumn(c.name, c.unit or of_kind.get(_kind(c), "")):
            np.array([row.get(c, np.nan) for row in kept], dtype=np.float64)
        for c in columns if c not in words
    }  # fmt: skip
