"""What a person sees of a run: progress while it works, tables at its end."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any, Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from cell.files.quantity import percent
from cell.records.result import AgreementCheck, Outcome, Result
from cell.run.computer_check import Condition
from cell.run.machine import MachineEvent
from cell.terminal.progress import Stage, Ticker

#: What the keys do during a run, and what is then said of them.
MAY_HOLD = "h: hold"
KEYS = {
    "h": (MachineEvent.HOLD, "holding; u: go on"),
    "u": (MachineEvent.UNHOLD, MAY_HOLD),
}

#: Steps that are said in other words than their names.
_STEPS = {"warm_up": "warm up (on a new computer it compiles, once)"}
#: Cables that have a column of their own in the table of times.
MOST_COLUMNS = 5

_COLOURS = {
    Outcome.INSERTED: "green",
    Outcome.MISSED: "red",
    Outcome.REJECTED: "yellow",
    Outcome.FAILED: "red",
    Outcome.MEASURED: "green",
    Outcome.REHEARSED: "green",
    Outcome.UNFIT: "red",
}

#: What a run may come to without anything to be said of it.
_GOOD = (Outcome.INSERTED, Outcome.MEASURED, Outcome.REHEARSED)

#: SI unit → unit for people, how many of it, and how it is written.
_SHOWN = {
    "m": ("mm", 1e3, ".2f"),
    "s": ("ms", 1e3, ".2f"),
    "rad": ("mrad", 1e3, ".2f"),
    "m/s": ("mm/s", 1e3, ".0f"),
    "Hz": ("Hz", 1.0, ".1f"),
    "": ("", 1.0, ".4g"),
}


class RunProgress:
    """A line that moves on with every step, on the error stream; off a terminal one every 10 s.

    The time left is that of the cycles left, as long as those so far.

    steps  names of those of one cycle, in their order
    """

    def __init__(
        self,
        cycles: int,
        steps: Sequence[str],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._cycles = cycles
        self._steps = steps
        self._now_s = now_s
        self._started_s = now_s()
        self._stage = Stage("connect", 0, cycles, self._started_s)
        self._ticker: Ticker | None = None
        console = Console(stderr=True)
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("cable {task.fields[number]} of {task.fields[cycles]}"),
            BarColumn(bar_width=16),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[hint]}"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> RunProgress:
        self._progress.start()
        self._line = self._progress.add_task(
            "",
            total=self._cycles * len(self._steps),
            number=1,
            cycles=self._cycles,
            left="",
            hint="",
        )
        if self._progress.disable:
            self._ticker = Ticker(self.line)
        return self

    def line(self) -> str:
        """What is said off a terminal."""
        return f"run: {self._stage.line(self._started_s, self._now_s())}"

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        if self._ticker is not None:
            self._ticker.close()

    def step(self, number: int, step: str) -> None:
        """A step of a cycle begins."""
        if step in self._steps:
            done = (number - 1) * len(self._steps) + self._steps.index(step)
            self._progress.update(self._line, completed=done)
        words = _STEPS.get(step, step.replace("_", " "))
        now_s = self._now_s()
        self._stage = self._stage.then(f"{words}, cables done", number - 1, self._cycles, now_s)
        left = self._stage.remaining(now_s)
        self._progress.update(self._line, description=words, number=number, left=left)

    def print_line(self, words: str) -> None:
        """Print a line that stays, above the one that moves on."""
        self._progress.console.print(words, markup=False, highlight=False, soft_wrap=True)

    def hint(self, words: str) -> None:
        """Say which key does what."""
        self._progress.update(self._line, hint=words)


def results_table(results: Sequence[Result]) -> Table:
    """One row per cable; lengths in mm."""
    table = Table(title="cables (lengths in mm)", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in (
        "cable",
        "outcome",
        "offset",
        "predicted\nmiss",
        "measured\nmiss",
        "margin",
        "forecast\nerror",
        "passes\nwith",
    ):
        justify: Literal["left", "right"] = "left" if heading == "outcome" else "right"
        table.add_column(heading, justify=justify, no_wrap=True)
    for r in results:
        table.add_row(
            str(r.cycle),
            f"[{_COLOURS[r.outcome]}]{r.outcome.value}[/]{_tries(r)}",
            _mm(r.offset_m, ".0f"),
            _mm(r.predicted_miss_m, "+z.2f"),
            _mm(r.measured_miss_m, "+z.2f"),
            _mm(r.margin_m, "+z.2f"),
            _mm(r.prediction_error_m, ".2f"),
            "" if r.probability is None else f"{percent(r.probability)}%",
        )
    return table


def checks_table(result: Result) -> Table:
    """What a dry run found out, and what it must be."""
    at = "" if result.speed is None else f" at {result.speed:.0%} of the speed"
    table = Table(title=f"dry run{at}: {result.outcome.value}", box=SIMPLE_HEAD)
    for heading in ("", "found", "must be", ""):
        table.add_column(heading, justify="left" if not heading else "right", no_wrap=True)
    for check in result.checks:
        wanted = _wanted(check)
        verdict = "[green]right[/]" if check.right else "[red]wrong[/]"
        table.add_row(check.what, _shown(check), wanted, verdict if wanted else "")
    return table


def conditions_table(conditions: Sequence[Condition]) -> Table:
    """What a cell needs of its computer, beside what is there."""
    table = Table("condition", "here", "needed", "", box=SIMPLE_HEAD)
    for c in conditions:
        table.add_row(c.name, c.measured, c.needed, "[green]met[/]" if c.met else "[red]not met[/]")
    return table


def seconds_table(results: Sequence[Result], steps: Sequence[str]) -> Table:
    """Time of each step: one column per cable, or median and longest of many cables.

    steps  names in the order of the rows; those that few cables come to stand below
    """
    table = Table(title="seconds per step", box=SIMPLE_HEAD)
    table.add_column("step")
    many = len(results) > MOST_COLUMNS
    for heading in ["median", "longest"] if many else [f"cable {r.cycle}" for r in results]:
        table.add_column(heading, justify="right")

    def row(name: str, times: Sequence[float | None]) -> None:
        known = [t for t in times if t is not None]
        if not known:
            return
        shown = [median(known), max(known)] if many else times
        table.add_row(name, *("" if t is None else f"{t:.3f}" for t in shown))

    for step in dict.fromkeys([*steps, *(step for r in results for step in r.seconds)]):
        row(step.replace("_", " "), [r.seconds.get(step) for r in results])
    table.add_section()
    row("all", [sum(r.seconds.values()) for r in results])
    row("robot waited for the computer", [r.wait_s for r in results])
    if any(r.hold_saved_s for r in results):
        row("hold ended early by", [r.hold_saved_s for r in results])
    return table


def troubles(results: Sequence[Result]) -> list[str]:
    """One line for every cable that was not inserted: why, and what to do."""
    lines = []
    for r in results:
        if r.fault is not None:
            device = f"{r.fault.device}: " if r.fault.device else ""
            remedy = f"; {r.fault.remedy}" if r.fault.remedy else ""
            cable = f"; {r.fault.cable}" if r.fault.cable else ""
            lines.append(
                f"cable {r.cycle} failed in step {r.fault.step}: "
                f"{device}{r.fault.cause}{remedy}{cable}"
            )
        elif r.outcome is Outcome.UNFIT:
            lines += [f"{c.what}: {_shown(c)}; {c.remedy}" for c in r.checks if not c.right]
        elif r.outcome not in _GOOD:
            lines.append(f"cable {r.cycle} {r.outcome.value}: {r.reason}")
    return lines


def parameters_table(model: Mapping[str, Any]) -> Table:
    """A cable's parameters with their 95 % intervals; `model` as `Identified.to_dict` gives it."""
    table = Table(title="parameters", box=SIMPLE_HEAD)
    for heading in ("parameter", "value", "95 % from", "to", "unit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
    for p in model["parameters"]:
        numbers = (f"{p[key]:.4g}" for key in ("value", "low", "high"))
        table.add_row(Text(p["name"]), *numbers, Text(p["unit"]))
    return table


def _tries(result: Result) -> str:
    """Which try it was, if the cable was stopped in front of the opening before."""
    return f", try {len(result.stops) + 1}" if result.stops else ""


def _mm(value_m: float | None, form: str) -> str:
    return "" if value_m is None else format(value_m * 1e3, form)


def _shown(check: AgreementCheck) -> str:
    unit, factor, form = _SHOWN[check.unit]
    return f"{check.found * factor:{form}} {unit}".rstrip()


def _wanted(check: AgreementCheck) -> str:
    unit, factor, _ = _SHOWN[check.unit]
    low, high = (None if v is None else f"{v * factor:g}" for v in (check.low, check.high))
    if low is None or high is None:
        words = "" if low is high else f"≥ {low}" if high is None else f"≤ {high}"
    else:
        words = f"{low} … {high}"
    return f"{words} {unit}".strip() if words else ""
