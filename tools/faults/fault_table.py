"""Results of fault trials: a summary and a table."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from tools.faults.fault_kills import STILL_S, KilledProcess
from tools.faults.fault_kinds import FaultTrial

#: Columns of the table; `goal`: limit for 99 % of all trials.
COLUMNS = ("condition", "n", "passed", "stop_median_ms", "stop_p99_ms", "stop_largest_ms", "goal",
           "largest_in_step", "still_largest_ms")  # fmt: skip


def stop_percentiles_ms(trials: Sequence[FaultTrial], *q: float) -> list[float]:
    """Percentiles of the time from fault to stop; nan if nothing had to be stopped."""
    known = [1e3 * t.reaction_s for t in trials if t.reaction_s is not None]
    return list(np.percentile(known or [np.nan], q))


def summary(trials: Sequence[FaultTrial], kills: Sequence[KilledProcess]) -> list[str]:
    """Sentences: number of passed trials, times to standstill, and load of the computer."""
    good, repeated = sum(not t.wrong for t in trials), sum(t.attempts > 1 for t in trials)
    lines = [f"{good} of {len(trials)} trials passed, {repeated} of them not at the first attempt."]
    median, p99, largest = stop_percentiles_ms(trials, 50.0, 99.0, 100.0)
    if not np.isnan(median):
        lines.append(
            f"From fault to stop: median {median:.0f} ms, p99 {p99:.0f} ms, "
            f"largest {largest:.0f} ms (bar: p99 ≤ 100 ms)."
        )
    if kills:
        moving = sum(k.speed_m_per_s > 0.02 for k in kills)
        worst = max(k.moved_on_s for k in kills)
        lines.append(
            f"{len(kills)} kills, {moving} of them of a moving arm: it moved on for at most "
            f"{1e3 * worst:.0f} ms (bar: 200 ms)."
        )
    return [*lines, f"Load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."]


def table(
    trials: Sequence[FaultTrial], kills: Sequence[KilledProcess], goal_ms: float
) -> list[tuple[str, ...]]:
    """A line for all trials, for every device and fault, and for every process that was killed."""
    groups = {"all": list(trials)}
    for trial in trials:
        groups.setdefault(f"{trial.kind.device}: {trial.kind.fault}", []).append(trial)
    lines = [_line(name, some, goal_ms) for name, some in groups.items() if some]
    for victim in dict.fromkeys(k.victim for k in kills):
        moved_ms = [1e3 * k.moved_on_s for k in kills if k.victim == victim]
        passed = sum(ms <= 1e3 * STILL_S for ms in moved_ms)
        counts = (str(len(moved_ms)), str(passed))
        lines.append((f"killed: {victim}", *counts, *[""] * 5, f"{max(moved_ms):.0f}"))
    return lines


def _line(name: str, some: Sequence[FaultTrial], goal_ms: float) -> tuple[str, ...]:
    stop = [""] * 5
    stopped = {t.reaction_s: t.step for t in reversed(some) if t.reaction_s is not None}
    if stopped:
        times_ms = [f"{ms:.0f}" for ms in stop_percentiles_ms(some, 50.0, 99.0, 100.0)]
        stop = [*times_ms, f"{goal_ms:g}", stopped[max(stopped)]]
    passed = sum(not t.wrong for t in some)
    still_ms = 1e3 * max(t.moved_on_s for t in some)
    return (name, str(len(some)), str(passed), *stop, f"{still_ms:.0f}")


def failures(trials: Sequence[FaultTrial]) -> list[str]:
    """A line for each trial that did not pass."""
    return [f"- {t.name}: {'; '.join(t.wrong)}" for t in trials if t.wrong]


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """The table as Markdown."""
    head = [COLUMNS, ["---"] * len(COLUMNS)]
    return "\n".join(f"| {' | '.join(line)} |" for line in [*head, *lines])
