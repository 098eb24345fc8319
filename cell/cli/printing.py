"""Prints texts and tables; numbers are never truncated, however narrow the terminal.

Rich is imported with the first table, so that help is quick.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import zip_longest
from typing import TYPE_CHECKING

from cell.files.table import TableData

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

#: A column of words may be folded to this width before its table is taken apart.
LEAST_WORDS = 12


def show(*parts: str | TableData, console: Console | None = None) -> None:
    """Print texts verbatim, and tables without truncating numbers.

    A table that is too wide for its terminal becomes one line for each value; off a terminal it is
    as wide as it needs to be.
    """
    if console is None:
        from rich.console import Console

        console = Console()
    for part in parts:
        if isinstance(part, TableData):
            _show_table(console, part)
        else:
            console.print(part, highlight=False, markup=False, soft_wrap=True)


def _show_table(console: Console, data: TableData) -> None:
    table = _rich_table(data)
    natural = console.measure(table, options=console.options.update(width=10_000)).maximum
    if not console.is_terminal:
        console.width = max(console.width, natural)
    elif natural > console.width:
        heads = [
            "\n".join(head.split()) if i in data.numbers else head
            for i, head in enumerate(data.heads)
        ]
        between = natural - sum(_widths(data)) - len(heads)  # a space less before each column
        data = replace(data, heads=heads)
        table = _rich_table(data, compact=True)
        least = sum(
            width if i in data.numbers else min(width, LEAST_WORDS)
            for i, width in enumerate(_widths(data))
        )
        if between + least > console.width:
            console.print(_upright(data), highlight=False, soft_wrap=True)
            return
    console.print(table, highlight=False)


def _widths(data: TableData) -> list[int]:
    """Characters of each column."""
    from rich.cells import cell_len

    columns = zip_longest(data.heads, *data.rows, fillvalue="")
    return [max(cell_len(x) for text in column for x in text.split("\n")) for column in columns]


def _rich_table(data: TableData, *, compact: bool = False) -> Table:
    """The table with its cells as they are: what stands in brackets is no markup."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    padding = (0, 1, 0, 0) if compact else (0, 1)
    title, note = data.title or None, data.note or None
    table = Table(title=title, box=SIMPLE_HEAD, caption=note, padding=padding)
    for i, (head, width) in enumerate(zip(data.heads, _widths(data), strict=True)):
        if i in data.numbers:
            table.add_column(Text(head), justify="right", no_wrap=True, min_width=width)
        else:
            table.add_column(Text(head), overflow="fold")
    for i, row in enumerate(data.rows):
        table.add_row(*(Text(cell, data.colours.get(cell, "")) for cell in row))
        if i in data.ends:
            table.add_section()
    return table


def _upright(data: TableData) -> Text:
    """One line for each value that is not empty, an empty line between rows."""
    from rich.text import Text

    lines = [Text(data.title, style="italic")] if data.title else []
    for row in data.rows:
        lines.append(Text(""))
        lines += [
            _value_line(*pair, data) for pair in zip(data.heads, row, strict=False) if pair[1]
        ]
    if data.note:
        lines += [Text(""), Text(data.note)]
    return Text("\n").join(lines)


def _value_line(head: str, cell: str, data: TableData) -> Text:
    from rich.text import Text

    name = " ".join(head.split())
    value = Text(cell, data.colours.get(cell, ""))
    return Text.assemble(f"{name}: " if name else "", value)
