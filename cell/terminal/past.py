"""What a person sees of past cycles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from cell.records.folder import Recorded
from cell.records.ledger.effectiveness import Shift
from cell.records.ledger.ledger import ListedCycle
from cell.records.past_cycles import UNFINISHED, PastCycle
from cell.terminal.console import (
    checks_table,
    parameters_table,
    results_table,
    seconds_table,
    troubles,
)

#: Outcomes of which the step is worth saying.
_IN_STEP = ("failed", UNFINISHED)


def history_table(past: Sequence[PastCycle]) -> Table:
    """One row per cycle; lengths in mm."""
    table = Table(title="cycles (lengths in mm)", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("folder", "outcome", "offset", "forecast\nerror", "pictures"):
        left = heading in ("folder", "outcome")
        table.add_column(heading, justify="left" if left else "right", no_wrap=True)
    for p in past:
        table.add_row(
            Text(p.folder.name),
            f"{p.outcome} in step {p.step}" if p.outcome in _IN_STEP else p.outcome,
            "" if p.offset_m is None else f"{p.offset_m * 1e3:.0f}",
            "" if p.prediction_error_m is None else f"{p.prediction_error_m * 1e3:.2f}",
            str(len(p.pictures)) if p.pictures else "",
        )
    return table


def record_parts(record: Recorded, pictures: Sequence[Path]) -> list[RenderableType]:
    """All that is worth seeing of a cycle: result, why, parameters, times, where pictures are."""
    result = record.result
    if result is None:
        parts: list[RenderableType] = [
            f"{record.folder}: ended without a result in step {record.step}; "
            "it still runs or was killed"
        ]
    else:
        table = checks_table(result) if result.checks else results_table([result])
        parts = [table, *troubles([result])]
        if record.model is not None:
            parts.append(parameters_table(record.model))
        parts.append(seconds_table([result], list(result.seconds)))
    study = "study" if record.study is not None else ""
    there = [name for name in (study, *(p.name for p in pictures)) if name]
    return [*parts, *(f"{record.folder / name}" for name in there)]


def cycles_parts(
    cycles: Sequence[ListedCycle], counts: Mapping[str, int]
) -> Sequence[RenderableType]:
    """One row per cycle, lengths in mm; how many there are in all, by outcome."""
    total = sum(counts.values())
    if not total:
        return ["no such cycle is listed"]
    lines, parts = len({c.line for c in cycles}) > 1, any(c.part for c in cycles)
    products = any(c.product for c in cycles)
    shown = (("line", lines), ("product", products), ("part", parts))
    left = ["begun", *(name for name, is_shown in shown if is_shown), "outcome"]
    table = _table("cycles (lengths in mm)", left, ["offset", "miss", "expected", "s"])
    for c in cycles:
        missed, expected = c.numbers["measured_miss_m"], c.numbers["predicted_miss_m"]
        table.add_row(
            f"{c.started:%Y-%m-%d %H:%M:%S}",
            *([Text(c.line)] if lines else []),
            *([Text(c.product or "")] if products else []),
            *([Text(c.part or "")] if parts else []),
            Text(_outcome(c)),
            _mm(c.numbers["offset_m"], 0),
            _mm(missed, 2),
            _mm(expected, 2),
            "" if c.running_s is None else f"{c.running_s:.1f}",
        )
    by_outcome = ", ".join(f"{n} {outcome}" for outcome, n in sorted(counts.items()))
    more = "" if total == len(cycles) else f", the newest {len(cycles)} above"
    return [table, f"{total} {'cycles' if total > 1 else 'cycle'}: {by_outcome}{more}"]


def faults_parts(faults: Sequence[tuple[str, int, str]]) -> Sequence[RenderableType]:
    """One row per code, the most frequent first."""
    if not faults:
        return ["no cycle was ended by a fault"]
    table = _table("faults", ["code", "newest cause"], ["cycles"])
    for code, number, cause in faults:
        table.add_row(code, Text(cause), str(number))
    return [table]


def shifts_parts(shifts: Sequence[Shift]) -> Sequence[RenderableType]:
    """One row per shift, shares in %."""
    if not shifts:
        return ["no shift with a cable to be inserted"]
    headings = ["cables", "inserted", "availability", "performance", "quality", "OEE"]
    table = _table("shifts (shares in %)", ["shift"], headings)
    for s in shifts:
        shares = (s.availability, s.performance, s.quality, s.oee)
        table.add_row(
            f"{s.begin:%Y-%m-%d %H:%M} to {s.end:%H:%M}",
            str(s.cables),
            str(s.inserted),
            *("" if share is None else f"{100.0 * share:.1f}" for share in shares),
        )
    ideal = shifts[0].ideal_s
    said = [] if ideal is None else [f"a cable needs {ideal:.1f} s at best"]
    if any(s.availability is None for s in shifts):
        said.append("no availability: simulated time is not the clock's")
    return [table, *said]


def _outcome(cycle: ListedCycle) -> str:
    """With the fault's code, and a mark on one that nobody has acknowledged."""
    if cycle.fault is None:
        return cycle.outcome
    return f"{cycle.outcome}: {cycle.fault.code}{'' if cycle.acknowledged else ' (open)'}"


def _table(title: str, left: Sequence[str], right: Sequence[str]) -> Table:
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in left:
        table.add_column(heading, no_wrap=heading != "newest cause")
    for heading in right:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _mm(length_m: float | None, digits: int) -> str:
    return "" if length_m is None else f"{length_m * 1e3:.{digits}f}"
