"""Separates records of several sources in one document: topics, clocks, frames, and trials."""

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
from cell.study.imports.documents import cells, read_document, record_lists
from cell.study.imports.groups import Tree
from cell.study.imports.transforms import transforms_tree
from cell.study.imports.units import METRES, RADIANS, unit_of

#: Maximum number of sources; each has positions or angles of its own.
_MAX_SOURCES = 20
_MEASURED = (ColumnKind.COORDINATE, ColumnKind.ANGLE, ColumnKind.QUATERNION)
#: Words of events that start and end a trial.
_START_WORDS = frozenset(("start", "begin", "started", "begun"))
_END_WORDS = frozenset(
    ("stop", "end", "stopped", "ended", "finish", "finished", "done", "complete", "completed")
)
#: Name of the source of records, without their parts that have a clock of their own.
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
    document = read_document(path)
    if (transforms := transforms_tree(path, document.whole)) != ({}, {}):
        return transforms
    for name, records in record_lists(document.content).items():
        rows = [dict(cells(record)) for record in records]
        if _time(rows) is not None and any(_is_measured(c) for row in rows for c in row):
            parts[name] = rows
    if len(parts) < 2:
        parts = {}
        for _, record in document.records:
            for source, part in _by_clock(record).items():
                parts.setdefault(source, []).append(dict(cells(part)))
    single = _with_times(next(iter(parts.values()), [])) if len(parts) < 2 else []
    parts = parts if len(parts) > 1 else _by_source(single)
    windows = [w for rows in parts.values() for w in _windows(rows)]
    if len(parts) < 2 or (single and not windows and _in_order(single)):
        return {}, {}  # the document is a single table
    tree: Tree = {}
    units: dict[tuple[str, ...], str] = {}
    for window in (*windows,) or (None,):
        for source, rows in parts.items():
            key = (source,) if window is None else (window.name, source)
            for column, values in _series(rows, window).items():
                tree[*key, column.name] = values
                units[*key, column.name] = column.unit
    return tree, units


def _with_times(rows: Sequence[Row]) -> list[Row]:
    """Rows in the order of their reception; events without a time have that of a neighbour.

    A trial ends at the latest time before its event, and begins with the next one after that.
    """
    result, time = list(rows), _time(rows)
    if time is None:
        return result
    stamps = np.array([row.get(time, np.nan) for row in rows], dtype=np.float64)
    latest = np.fmax.accumulate(stamps)
    for i in np.flatnonzero(np.isnan(stamps)).tolist():
        words = {v.lower() for v in rows[i].values() if isinstance(v, str)}
        after = stamps[i:][np.isfinite(stamps[i:]) & ~(stamps[i:] <= latest[i])]
        if words & _START_WORDS and len(after):
            result[i] = rows[i] | {time: float(after[0])}
        elif words & _END_WORDS and np.isfinite(latest[i]):
            result[i] = rows[i] | {time: float(latest[i])}
    return result


def _by_clock(record: Any) -> dict[str, Any]:
    """A record without the gripper's parts that have other timestamps; and these parts."""
    if not isinstance(record, Mapping) or (own := _time_of(record)) is None:
        return {_RECORDS: record}
    separate = {
        key: part for key, part in record.items()
        if HAND.intersection(re.findall("[a-z]+", str(key).lower()))
        and isinstance(part, Mapping) and _time_of(part) not in (None, own)
    }  # fmt: skip
    return {_RECORDS: {k: v for k, v in record.items() if k not in separate}} | separate


def _time_of(record: Mapping[str, Any]) -> float | None:
    keys = (k for k in record if _kind(CapturedColumn(str(k))) is ColumnKind.TIME)
    return next((record[k] for k in keys if isinstance(record[k], int | float)), None)


def _by_source(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by the text column whose values share no measured column; else one group of all."""
    words = {c for c, value in rows[0].items() if isinstance(value, str)} if rows else set()
    for word in sorted(words, key=lambda c: c.name):
        parts: dict[str, list[Row]] = {}
        for row in rows:
            parts.setdefault(str(row.get(word, "")), []).append(row)
        if not 2 <= len(parts) <= _MAX_SOURCES:
            continue
        columns = [{c for row in part for c in row if _is_measured(c)} for part in parts.values()]
        if sum(map(bool, columns)) > 1 and len(set().union(*columns)) == sum(map(len, columns)):
            return dict(zip(_titles(list(parts)), parts.values(), strict=True))
    return {_RECORDS: list(rows)}


def _titles(names: Sequence[str]) -> list[str]:
    """Names of sources; a gripper's without words that no other one has, as `cobot` of its topic.

    By the words in common a gripper belongs to the markers of its trial.
    """
    words = [re.findall(r"[^\W_]+", name) for name in names]
    full = ["_".join(re.findall(r"\w+", name)) for name in names]
    titles = list(full)
    for i, own in enumerate(words):
        others = {word for k, each in enumerate(words) if k != i for word in each}
        kept = [word for word in own if word in others or word.lower() in HAND]
        if HAND.intersection(word.lower() for word in own if word not in others):
            titles[i] = titles[i] if kept == own else "_".join(kept)
    return titles if len(set(titles)) == len(titles) else full


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
    """Trials between start and end events; named by a text column of the event."""
    time, windows = _time(rows), list[TrialWindow]()
    start: float | None = None
    if time is None or any(_is_measured(c) for row in rows for c in row):
        return []
    timed = (row for row in rows if isinstance(row.get(time), float))
    for row in sorted(timed, key=lambda row: float(row[time])):
        words = {c.name: v for c, v in row.items() if isinstance(v, str)}
        values = {v.lower() for v in words.values()}
        if values & _START_WORDS:
            start = float(row[time])
        elif values & _END_WORDS and start is not None:
            trial = [v for n, v in words.items() if re.search(r"trial|run|test|name", n)]
            name = trial[0] if trial else f"trial_{len(windows) + 1}"
            name += f"_{len(windows) + 1}" if name in (window.name for window in windows) else ""
            windows.append(TrialWindow(name, start, float(row[time])))
            start = None
    return windows


def _series(rows: Sequence[Row], window: TrialWindow | None) -> dict[CapturedColumn, np.ndarray]:
    """Columns of a source within a trial, in order of time; none where it has no time."""
    if (time := _time(rows)) is None:
        return {}
    data = [row for row in rows if isinstance(row.get(time), float)]
    if window is not None:
        data = [row for row in data if window.begins <= float(row[time]) <= window.ends]
    data.sort(key=lambda row: float(row[time]))
    columns = list(dict.fromkeys(c for row in data for c in row))
    words = {c for c in columns if any(isinstance(row.get(c), str) for row in data)}
    units = {unit_of(str(row[c])) for c in words if "unit" in c.name for row in data if c in row}
    length, angle = (next(iter(units & set(units_of)), "") for units_of in (METRES, RADIANS))
    of_kind = {ColumnKind.COORDINATE: length, ColumnKind.ANGLE: angle}
    return {
        CapturedColumn(c.name, c.unit or of_kind.get(_kind(c), "")):
            np.array([row.get(c, np.nan) for row in data], dtype=np.float64)
        for c in columns if c not in words
    }  # fmt: skip
