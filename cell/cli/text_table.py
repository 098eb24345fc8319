"""Tables at a terminal."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from cell.files.table import TableData


def text_table(data: TableData) -> Table:
    """The table with its cells as they are: what stands in brackets is no markup."""
    table = Table(title=data.title or None, box=SIMPLE_HEAD, caption=data.note or None)
    for i, head in enumerate(data.heads):
        table.add_column(head, justify="right" if i in data.numbers else "left")
    for i, row in enumerate(data.rows):
        table.add_row(*(Text(cell, data.colours.get(cell, "")) for cell in row))
        if i in data.ends:
            table.add_section()
    return table
