"""Delivers results: prints them, then writes their files; a failure of one leaves the other.

Numbers in tables are never truncated, however narrow the terminal.  Rich is imported with the first
table, so that help is quick.
"""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from cell.cli.shared import NOT_ALL_DONE, STDOUT, answering, handled
from cell.cli.streams import OutputClosedError, emit, without_reader
from cell.computer.watched import ANSWERED
from cell.files.rescue import write_or_rescue
from cell.files.table import TableData

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

Json = Annotated[
    Path | None,
    typer.Option(
        "--json",
        help="Print the result as JSON instead of tables. (Older form: --json FILE writes it.)",
        show_default=False,
        metavar="",
    ),
]


class JsonCommand(TyperCommand):
    """Command with `--json` (print JSON) or `--json FILE` (write it: the older form).

    A word after `--json` is a file unless a required argument would be missing without it.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Give every bare `--json` the standard output for its file."""
        for i, word in reversed(list(enumerate(args))):
            following = args[i + 1] if i + 1 < len(args) else "--"
            if word == "--json" and (
                (following.startswith("-") and following != str(STDOUT))
                or not self.is_complete(self._parse(ctx, [*args[:i], *args[i + 2 :]]))
            ):
                args = [*args[: i + 1], str(STDOUT), *args[i + 1 :]]
        return super().parse_args(ctx, args)

    def is_complete(self, values: Mapping[str, Any]) -> bool:
        """Whether every required argument has a value; `values` by parameter name."""
        return all(
            isinstance(values.get(str(parameter.name)), str | tuple | list)
            for parameter in self.params
            if parameter.param_type_name == "argument" and parameter.required
        )

    def _parse(self, ctx: Any, args: list[str]) -> Mapping[str, Any]:
        values: Mapping[str, Any] = self.make_parser(ctx).parse_args(list(args))[0]
        return values


def print_json(data: Any) -> None:
    """Print plain data as JSON.  Raises OutputClosedError: not if only its reader went away."""
    with without_reader():
        emit(json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False))


#: A file, and the function that writes it to a path.
Delivery = tuple[Path | None, Callable[[Path], object]]


def deliver(printed: Callable[[], None], *files: Delivery) -> None:
    """Print a result, then write its files, even if printing or one of the files fails.

    A file that cannot be written goes to the folder of temporary files instead; this is reported
    and ends with 1.  Ctrl-C or SIGTERM end the printing; the files are written.

    files   None and the standard output are skipped
    raises  OutputClosedError, OSError: the result cannot be printed; its files are written
    """
    unheard: Exception | None = None
    with answering() as interrupted:
        try:
            with without_reader():
                printed()
                sys.stdout.flush()
        except KeyboardInterrupt:
            pass
        except (OutputClosedError, OSError) as error:
            unheard = error
        with handled(signal.SIG_IGN, *ANSWERED):
            troubles = [
                message
                for path, write in files
                if path is not None and path != STDOUT and (message := write_or_rescue(path, write))
            ]
            for message in troubles:
                print(message, file=sys.stderr)
    if unheard is not None:
        raise unheard
    interrupted.end_command()
    if troubles:
        raise typer.Exit(NOT_ALL_DONE)


def deliver_result(
    data: dict[str, Any],
    places: Sequence[Path | None],
    parts: Callable[[], Iterable[str | TableData]],
    *files: Delivery,
) -> None:
    """Print a result, write it as JSON, and write its other files; see `deliver`.

    places  where the JSON goes; if it goes to the standard output, `parts` are not printed
    parts   gives the texts and tables for people
    """
    from cell.lab.data.results import write_json

    def printed() -> None:
        if STDOUT in places:
            print_json(data)
        else:
            show(*parts())

    deliver(printed, *((place, partial(write_json, data)) for place in places), *files)


#: Least width of a folded column of words; below it the table is printed as lines.
LEAST_WORDS = 12


def show(*parts: str | TableData, console: Console | None = None) -> None:
    """Print texts verbatim, and tables without truncating numbers.

    A table that is too wide for its terminal becomes one line for each value; off a terminal it is
    as wide as it needs to be.
    """
    if console is None:
        from rich.console import Console

        console = Console()
    with without_reader():
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
    """The table with verbatim cells: text in brackets is no markup."""
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
