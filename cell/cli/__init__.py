"""Commands of the cell, one module for each group of them: parse, call, print.

Heavy imports wait until a command needs them, so that help is quick.
"""

from __future__ import annotations

from typing import Annotated

import typer

from cell.cli import calibrate, lab, line, records, run, settings
from cell.cli.streams import usable_streams
from cell.terminal.logs import about, to_terminal

app = typer.Typer(
    name="cell",
    help="Grips bendable cables, identifies each from pictures of its swing, and inserts it.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for group in (run, settings, records, lab, line):
    app.add_typer(group.app)
app.add_typer(calibrate.app)


def _version(wanted: bool) -> None:
    if wanted:
        print(about())
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_version,
            is_eager=True,
            help="Print the version of program, Python and computer.",
        ),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print the log on the error stream.")
    ] = False,
) -> None:
    """Grips bendable cables, identifies each from pictures of its swing, and inserts it."""
    to_terminal(verbose=verbose)


def main() -> None:
    """Entry point of the console script."""
    with usable_streams():
        app()
