"""Facts of a study's trials as a table for a terminal."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from cell.lab.report.look_page import FACT_HEADS, Look, fact_rows

#: The first columns, and the last one, hold words.
_WORDS = (0, 1, len(FACT_HEADS) - 1)


def fact_table(look: Look) -> Table:
    """One row per trial."""
    table = Table(title=f"{look.name}: {len(look.trials)} trials", box=SIMPLE_HEAD)
    for number, head in enumerate(FACT_HEADS):
        table.add_column(head, justify="left" if number in _WORDS else "right")
    for row in fact_rows(look.facts):
        table.add_row(*(Text(cell) for cell in row))
    return table
