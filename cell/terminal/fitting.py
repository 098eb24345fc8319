"""Tables that fit: numbers are never cut, whatever the width of the terminal."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from cell.files.table import TableData

#: A column of words may be folded to this width before its table is taken apart.
LEAST_WORDS = 12


def show(console: Console, *parts: RenderableType) -> None:
    """Print texts as they are, brackets included, and tables so that no number of them is cut.

    A table that is too wide for its terminal becomes one line for each value; off a terminal it is
    as wide as it needs to be.
    """
    for part in parts:
        if isinstance(part, Table):
            _show_table(console, part)
        else:
            console.print(part, highlight=False, markup=False, soft_wrap=True)


def _show_table(console: Console, table: Table) -> None:
    natural = console.measure(table, options=console.options.update(width=10_000)).maximum
    if not console.is_terminal:
        console.width = max(console.width, natural)
        console.print(table, highlight=False)
        return
    given = sum(_widths(table))
    for column in table.columns:
        if column.justify == "right" and natural > console.width:
            column.header = "\n".join(_text(column.header).plain.split())
    least = 0
    for column, width in zip(table.columns, _widths(table), strict=True):
        if column.justify == "right" or column.no_wrap:
            column.no_wrap = True
            column.min_width = width
            least += width
        else:
            column.overflow = "fold"
            least += min(width, LEAST_WORDS)
    if natural - given + least <= console.width:
        console.print(table, highlight=False)
    else:
        console.print(_upright(table), highlight=False, soft_wrap=True)


def _widths(table: Table) -> list[int]:
    return [max(_width(cell) for cell in (c.header, *c.cells)) for c in table.columns]


def _upright(table: Table) -> Text:
    """One line for each value that there is, a line's space between rows."""
    lines = [Text(str(table.title), style="italic")] if table.title else []
    headings = [" ".join(_text(c.header).plain.split()) for c in table.columns]
    columns = [list(c.cells) for c in table.columns]
    for row in zip(*columns, strict=True):
        values = [_text(cell) for cell in row]
        lines += [Text(""), *_lines(headings, values)]
    if table.caption:
        lines += [Text(""), _text(table.caption)]
    return Text("\n").join(lines)


def _lines(headings: list[str], values: list[Text]) -> list[Text]:
    return [
        Text.assemble(f"{heading}: " if heading else "", value)
        for heading, value in zip(headings, values, strict=True)
        if value.plain
    ]


def _text(cell: Any) -> Text:
    return cell if isinstance(cell, Text) else Text.from_markup(str(cell))


def _width(cell: Any) -> int:
    return max((cell_len(line) for line in _text(cell).plain.splitlines()), default=0)


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
