"""What a person sees of past cycles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from cell.records.folder import Recorded
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
