"""An export as sentences and a table."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from cell.exchange.export import Export
from cell.exchange.peer import BAR_M


def export_parts(done: Export, out: Path) -> Iterator[Table | str]:
    """What was written, what is not in it, and how far the tips are apart, mm."""
    yield f"written to {out}: {done.chain.links} links, steps of {done.step_s * 1e3:g} ms"
    yield f"effects in it: {', '.join(done.effects) or 'none'}"
    for effect in done.left_out:
        yield f"left out: {effect.name}: {effect.reason}"
    table = Table(title="Tip in MuJoCo, from the engine, mm", box=SIMPLE_HEAD)
    table.add_column("motion")
    for column in ("rms", "at most", *(("rms of what is left out",) if done.missing else ())):
        table.add_column(column, justify="right")
    for i, one in enumerate(done.differences):
        row = [f"{one.rms_m * 1e3:.3f}", f"{one.most_m * 1e3:.3f}"]
        if done.missing:
            row.append(f"{done.missing[i].rms_m * 1e3:.3f}")
        table.add_row(Text(one.name), *row)
    yield table
    if not done.within_bar:
        yield (
            f"The tip differs by more than {BAR_M * 1e3:g} mm rms: give more --links, or check the "
            "model; the file is written."
        )
