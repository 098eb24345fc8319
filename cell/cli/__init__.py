"""Commands of the cell, one module for each group of them: parse, call, print.

Heavy imports wait until a command needs them, so that help is quick.
"""

from __future__ import annotations

import typer

from cell.cli import calibrate, lab, line, records, run, settings
from cell.cli.streams import usable_streams

app = typer.Typer(
    name="cell",
    help="Grips bendable cables, identifies each from pictures of its swing, and inserts it.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
for group in (run, settings, records, lab, line):
    app.add_typer(group.app)
app.add_typer(calibrate.app)


def main() -> None:
    """Entry point of the console script."""
    with usable_streams():
        app()
