"""What a person sees of the ledger."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from cell.records.ledger.effectiveness import Shift
from cell.records.ledger.ledger import ListedCycle


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
