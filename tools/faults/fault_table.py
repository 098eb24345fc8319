"""What fault trials have shown: a summary, a table, and the same table as CSV."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from tools.faults.fault_kills import STILL_S, Kill


@dataclass(frozen=True)
class Row:
    """One trial.

    stop_ms   from the fault (or, if nobody needed the device then, from the step that did) until
              the arm was told to stop; nan if there was nothing to stop
    still_ms  from the same moment until the emulated arm stood still
    wrong     empty if passed
    """

    device: str
    fault: str
    step: str
    noticed_in: str
    stop_ms: float
    still_ms: float
    attempts: int
    wrong: str


def percentile(values: Sequence[float], q: float) -> float:
    """Of what is known; nan if nothing is."""
    known = [v for v in values if not np.isnan(v)]
    return float(np.percentile(known, q)) if known else float("nan")


def moving(kills: Sequence[Kill]) -> int:
    """Number of kills of a moving arm."""
    return sum(k.speed_m_per_s > 0.02 for k in kills)


def summary(rows: Sequence[Row], kills: Sequence[Kill]) -> list[str]:
    """Sentences: how many passed, and how fast all stood still."""
    good = sum(not r.wrong for r in rows)
    again = sum(r.attempts > 1 for r in rows)
    lines = [f"{good} of {len(rows)} trials passed, {again} of them not at the first attempt."]
    stops = [r.stop_ms for r in rows]
    if not np.isnan(percentile(stops, 50.0)):
        lines.append(
            f"From fault to stop: median {percentile(stops, 50.0):.0f} ms, "
            f"p99 {percentile(stops, 99.0):.0f} ms, largest {percentile(stops, 100.0):.0f} ms "
            "(bar: p99 ≤ 100 ms)."
        )
    if kills:
        worst = max(k.moved_on_s for k in kills)
        lines.append(
            f"{len(kills)} kills, {moving(kills)} of them of a moving arm: it moved on for at most "
            f"{1e3 * worst:.0f} ms (bar: 200 ms)."
        )
    return lines


#: Columns of the table; `goal`: 99 % of all trials stop within that.
COLUMNS = ("condition", "n", "passed", "stop_median_ms", "stop_p99_ms", "stop_largest_ms", "goal",
           "largest_in_step", "still_largest_ms")  # fmt: skip


def table(rows: Sequence[Row], kills: Sequence[Kill], goal_ms: float) -> list[tuple[str, ...]]:
    """A line for all trials, for every device and fault, and for every process that was killed."""
    groups = {"all": list(rows)}
    for row in rows:
        groups.setdefault(f"{row.device}: {row.fault}", []).append(row)
    out = [_line(name, some, goal_ms) for name, some in groups.items() if some]
    for victim in dict.fromkeys(k.victim for k in kills):
        moved_ms = [1e3 * k.moved_on_s for k in kills if k.victim == victim]
        passed = sum(ms <= 1e3 * STILL_S for ms in moved_ms)
        blank = ("",) * 5
        counts = (str(len(moved_ms)), str(passed))
        out.append((f"killed: {victim}", *counts, *blank, f"{max(moved_ms):.0f}"))
    return out


def _line(name: str, some: Sequence[Row], goal_ms: float) -> tuple[str, ...]:
    stops = [r for r in some if not np.isnan(r.stop_ms)]
    stop = ("", "", "", "", "")
    if stops:
        largest = max(stops, key=lambda r: r.stop_ms)
        middle, high = (percentile([r.stop_ms for r in stops], q) for q in (50.0, 99.0))
        stop = (f"{middle:.0f}", f"{high:.0f}", f"{largest.stop_ms:.0f}", f"{goal_ms:g}",
                largest.step)  # fmt: skip
    passed = sum(not r.wrong for r in some)
    return (name, str(len(some)), str(passed), *stop, f"{max(r.still_ms for r in some):.0f}")


def failures(rows: Sequence[Row]) -> list[str]:
    """A line for each trial that did not pass."""
    return [f"- {r.device}: {r.fault} in {r.step}: {r.wrong}" for r in rows if r.wrong]


def load_average() -> str:
    """How busy the computer is."""
    return f"Load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """The table, to read."""
    head = [COLUMNS, ["---"] * len(COLUMNS)]
    return "\n".join(f"| {' | '.join(line)} |" for line in [*head, *lines])


def csv_text(lines: Sequence[Sequence[str]], command: str) -> str:
    """The table with the day, the computer, its load and the command."""
    origin = {
        "measured_on": date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores",
        "load": f"load {os.getloadavg()[0]:.0f}",
        "command": command,
    }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*COLUMNS, *origin))
    writer.writerows((*line, *origin.values()) for line in lines)
    return text.getvalue()
