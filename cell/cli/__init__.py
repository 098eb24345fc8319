"""Commands of the cell, one module for each group of them: parse, call, print.

Heavy imports wait until a command needs them, so that help is quick.
"""

from __future__ import annotations

import logging
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

from cell.cli import (
    adapters,
    bundle,
    calibrate,
    export,
    fit,
    imports,
    lab,
    ledger,
    line,
    plant,
    recordings,
    run,
    serve,
    settings,
    studies,
)
from cell.cli.logs import about, to_file, to_terminal
from cell.cli.shared import BAD_INPUT, COMMAND_LINE
from cell.cli.streams import open_streams, reporting_reader, usable_streams
from cell.computer.watched import go_on_watched
from cell.files.overwriting import CommandLine

#: Commands that run a user's own effects, under a watchdog process.
WATCHED = (
    *("fit", "compare", "diagnose", "discover", "suggest", "power", "identify", "learn"),
    *("check", "effects", "promote", "export"),
)


#: Commands by purpose; help and completion list them in this order.
PANELS = {
    "Set up": ("init", "check", "doctor", "calibrate", "emulate", "schema"),
    "Run": ("run", "status", "send"),
    "Past cycles": (
        *("list", "show", "report", "identify", "replay", "recover", "upload", "fetch"),
    ),
    "Model lab": (
        *("import", "look", "study", "fit", "compare", "diagnose", "discover", "effects"),
        *("suggest", "power", "export"),
    ),
    "Line": ("learn", "promote", "history", "acknowledge"),
    "Plant": ("serve", "service", "mqtt", "opcua", "handshake"),
    "Administration": ("help", "user", "actions", "bundle"),
}
_FITTING, _LOOKING = ("fit", "compare", "discover"), ("diagnose", "suggest", "power")
#: Spellings of the version before: they work, with a note, until the next one.
OLD_OPTIONS: dict[str, dict[str, str]] = {
    **{command: {"--out": "--runs"} for command in ("run", "show", "service")},
    **{command: {"--ledger": "--runs"} for command in ("history", "acknowledge", "actions")},
    **{command: {"--effect": "--with"} for command in ("identify", *_FITTING, "export")},
    **{command: {"--effect": "--try", "--known": "--with"} for command in _LOOKING},
    "effects": {"--effect": "--try"},
    "learn": {"--effect": "--try", "--ledger": "--runs"},
}
#: Help text of a command that has no exit codes of its own.
_USUAL_CODES = """

Exit codes: 0; 2 if the input is wrong, and nothing is written; 130 if Ctrl-C has ended it."""
#: Text that `cell` prints without a command.
_FIRST = """\
Three things to do first:

  cell init --yes && cell run --config cell.yaml     insert a cable in a simulated cell
  cell serve --config cell.yaml                      watch the cell in a browser
  cell import swing.csv -o study                     find the physics of a swing of your own:
    && cell diagnose study                             `cell help import`

`cell --help` lists all commands, `cell help` the topics of the documentation."""


class _Commands(typer.core.TyperGroup):
    """All commands; Ctrl-C in one that does not handle it is reported, exit code 130.

    Ctrl-D at a prompt is reported too, exit code 2.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        """Names, in the order of `PANELS`."""
        return [name for names in PANELS.values() for name in names]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command, with its panel and its exit codes."""
        command: Any = super().get_command(ctx, cmd_name)
        if command is not None:
            of = (panel for panel, names in PANELS.items() if cmd_name in names)
            command.rich_help_panel = next(of)
            for one in (command, *getattr(command, "commands", {}).values()):
                if "Exit codes:" not in one.help:
                    one.help += _USUAL_CODES
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Name, command, and its arguments with options in their current spelling."""
        name, command, rest = super().resolve_command(ctx, args)
        old = OLD_OPTIONS.get(name or "", {})
        for i, word in enumerate(rest):
            option, equals, value = word.partition("=")
            if option in old:
                new = _new_option(name or "", option, value or "".join(rest[i + 1 : i + 2]))
                rest[i] = new + equals + value
                print(f"note: {option} is called {new} now", file=sys.stderr)
        COMMAND_LINE.set(CommandLine(name or "", rest))
        return name, command, rest

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        with _reporting_interruption():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        with _reporting_interruption():
            return super().invoke(ctx)


def _new_option(command: str, option: str, value: str) -> str:
    """Current spelling of an option of the previous version."""
    if (command, option) == ("diagnose", "--effect"):  # what is tried anyway was part of the model
        from cell.cable.effects import library

        return "--with" if value in library() else "--try"
    return OLD_OPTIONS[command][option]


@contextmanager
def _reporting_interruption() -> Iterator[None]:
    """Report an interruption; Typer alone ends without a message."""
    try:
        with reporting_reader():
            yield
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise
    except typer.Abort as abort:  # of a question
        if isinstance(abort.__context__, KeyboardInterrupt):
            print("interrupted", file=sys.stderr)
            raise KeyboardInterrupt from None
        print("the input ended before an answer: nothing is done", file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from None


app = typer.Typer(
    name="cell",
    cls=_Commands,
    help="Grips bendable cables, identifies each from pictures of its swing, and inserts it.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
)
for group in (
    *(run, plant, settings, ledger, bundle),
    *(recordings, fit, lab, studies, imports, export, line, adapters),
):
    app.add_typer(group.app)
app.add_typer(calibrate.app)
app.add_typer(serve.app)
app.add_typer(adapters.opcua_app)
app.add_typer(serve.users_app, name="user")


def _version(wanted: bool) -> None:
    if wanted:
        print(about())
        raise typer.Exit


@app.callback()
def options(
    ctx: typer.Context,
    *,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_version,
            is_eager=True,
            help="Print the versions of program and Python, and the computer.",
        ),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print the log on the error stream.")
    ] = False,
    log: Annotated[
        Path | None, typer.Option(help="Append the log to this file; it rotates at 2 MB.")
    ] = None,
) -> None:
    """Grips bendable cables, identifies each from pictures of its swing, and inserts it."""
    to_terminal(verbose=verbose)
    if log is not None:
        to_file(log)
    if ctx.invoked_subcommand is None:
        print(_FIRST)
        return
    logging.getLogger(__name__).info("cell %s", shlex.join(sys.argv[1:]))


def main() -> None:
    """Entry point of the console script."""
    open_streams()
    # matrices are small: a second thread of linear algebra only spins; read when numpy is loaded
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if next((word for word in sys.argv[1:] if not word.startswith("-")), "") in WATCHED:
        go_on_watched()
    with usable_streams():
        app()
