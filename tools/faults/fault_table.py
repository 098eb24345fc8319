"""What fault trials have shown: a summary on a page, and every trial as CSV behind it."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from tools.faults.fault_kills import Kill

INTRODUCTION = """# Fault trials

Written by `make fault-trials`: the real drivers against the emulators, a fault in every step. In
steps that move, the fault comes while the arm moves; otherwise when the step begins. *Stop* is
the time from the fault (or, if nobody needed the device then, from the step that did) until the
arm was told to stop; *still* until the emulated arm stood. A trial passes if device, step and
remedy are named, the record says the same, the jaws hold what they held, and after repair and
acknowledgement the next cycle inserts. Every trial stands in [fault_trials.csv](fault_trials.csv);
how these were gathered, in [measurements.md](measurements.md#fault-trials).
"""


@dataclass(frozen=True)
class Row:
    """One trial; `stop_ms` nan = there was nothing to stop, `wrong` empty = passed."""

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


def page(rows: Sequence[Row], said: Sequence[str], killed: Sequence[str]) -> str:
    """The page: what a summary says, a line for every device and fault, and the kills' table."""
    out = [
        INTRODUCTION,
        "\n".join(said),
        "",
        "| device | fault | steps | passed | stop, ms, median | largest | in step | still, ms, "
        "largest |",
        "|---|---|---:|---:|---:|---:|---|---:|",
    ]
    for device, fault in dict.fromkeys((r.device, r.fault) for r in rows):
        some = [r for r in rows if (r.device, r.fault) == (device, fault)]
        stopped = [r for r in some if not np.isnan(r.stop_ms)]
        passed = sum(not r.wrong for r in some)
        line = f"| {device} | {fault} | {len(some)} | {passed} |"
        if stopped:
            worst = max(stopped, key=lambda r: r.stop_ms)
            middle = percentile([r.stop_ms for r in stopped], 50.0)
            line += f" {middle:.0f} | {worst.stop_ms:.0f} | {worst.step} |"
        else:
            line += "  |  |  |"
        out.append(f"{line} {max(r.still_ms for r in some):.0f} |")
    failed = [f"- {r.device}: {r.fault} in {r.step}: {r.wrong}" for r in rows if r.wrong]
    if failed:
        out += ["", "Not passed:", "", *failed]
    if killed:
        out += ["", "## Processes killed", "", *killed]
    return "\n".join(out) + "\n"


def kills_table(kills: Sequence[Kill]) -> list[str]:
    """A line for every process that was killed."""
    if not kills:
        return []
    out = [
        "| killed | times | of a moving arm | moved on, ms, median | largest |",
        "|---|---:|---:|---:|---:|",
    ]
    for victim in dict.fromkeys(k.victim for k in kills):
        some = [k for k in kills if k.victim == victim]
        moved_ms = [1e3 * k.moved_on_s for k in some]
        out.append(
            f"| {victim} | {len(some)} | {moving(some)} | {percentile(moved_ms, 50.0):.0f} "
            f"| {max(moved_ms):.0f} |"
        )
    return out


def load_average() -> str:
    """How busy the computer is."""
    return f"Load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."


def csv_text(rows: Sequence[Row]) -> str:
    """All trials, a line each."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(f.name for f in fields(Row))
    for row in rows:
        writer.writerow(
            "" if v != v else f"{v:.0f}" if isinstance(v, float) else v for v in astuple(row)
        )
    return text.getvalue()
