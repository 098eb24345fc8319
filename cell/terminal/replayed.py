"""What a person sees of a replayed cycle."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from cell.records.result import Result
from cell.wiring.replay import Replayed


def replayed_parts(replayed: Replayed, most: int) -> list[RenderableType]:
    """Whether everything is the same, and what is not: `most` differences, the largest of all."""
    parts: list[RenderableType] = list(replayed.losses)
    result, found = replayed.result, replayed.differences
    if not replayed.complete:
        parts.append("the recording ends before its cycle does")
    if result.fault is not None:
        parts.append(f"the replay ended in step {result.fault.step}: {result.fault.cause}")
    if not replayed.decided:
        parts.append("nothing was decided in this cycle: only what came before is compared")
    for name, (then, now) in replayed.software.items():
        parts.append(f"{name} was {then}, now {now}")
    if not found:
        whole = replayed.complete and not replayed.losses
        what = result.outcome.value if whole else "what it holds"
        return [*parts, f"identical: {what}, every number to the last bit"]
    table = Table(title="differences", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("what", "then", "now"):
        table.add_column(heading, no_wrap=True)
    for difference in found[:most]:
        then, now = _short(difference.then), _short(difference.now)
        table.add_row(Text(difference.name), Text(then), Text(now))
    parts.append(table)
    if len(found) > most:
        parts.append(f"and {len(found) - most} more; --json has all")
    return parts


def imported_parts(result: Result) -> list[RenderableType]:
    """What was made of a film of one's own."""
    if result.fault is not None:
        return [f"the film ended in step {result.fault.step}: {result.fault.cause}"]
    table = Table(title="this cable (SI units)", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("parameter", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    for name, value in result.parameters.items():
        table.add_row(Text(name), f"{value:.4g}")
    parts: list[RenderableType] = [table] if result.parameters else []
    if result.reason is not None:
        parts.append(f"{result.outcome.value}: {result.reason}")
    if result.residual_rms_m is not None:
        parts.append(f"what the model leaves: {result.residual_rms_m * 1e3:.3f} mm rms")
    if result.offset_m is not None:
        parts.append(f"it would be inserted with an offset of {result.offset_m * 1e3:.0f} mm")
    return parts


def _short(value: Any) -> str:
    """A value in a table: numbers with all their digits, the rest cut."""
    if value is None:
        return "none"
    if isinstance(value, int | float | bool):
        return repr(value)
    text = str(value)
    return text if len(text) <= 30 else f"{text[:27]}..."
