"""Delivers results: prints them, then writes their files; a failure of one leaves the other."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from cell.cli.printing import show
from cell.cli.shared import NOT_ALL_DONE, STDOUT, answering, unhindered
from cell.cli.streams import OutputClosedError, emit
from cell.files.rescue import write_or_rescue
from cell.files.table import TableData

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
                or not self.is_complete(self._parsed(ctx, [*args[:i], *args[i + 2 :]]))
            ):
                args = [*args[: i + 1], str(STDOUT), *args[i + 1 :]]
        return super().parse_args(ctx, args)

    def is_complete(self, given: Mapping[str, Any]) -> bool:
        """Whether every required argument has a value; `given` has the words by parameter."""
        return all(
            isinstance(given.get(str(parameter.name)), str | tuple | list)
            for parameter in self.params
            if parameter.param_type_name == "argument" and parameter.required
        )

    def _parsed(self, ctx: Any, args: list[str]) -> Mapping[str, Any]:
        given: Mapping[str, Any] = self.make_parser(ctx).parse_args(list(args))[0]
        return given


def print_json(data: Any) -> None:
    """Print plain data as JSON.  Raises OutputClosedError."""
    emit(json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False))


#: A file, and what writes it to wherever it is told.
Delivery = tuple[Path | None, Callable[[Path], None]]


def deliver(printed: Callable[[], None], *files: Delivery) -> None:
    """Print a result, then write its files, even if printing or one of the files fails.

    A file that cannot be written where it should be goes to the folder of temporary files, and is
    told of.  Ends with 1 then.  Ctrl-C or SIGTERM end the printing; the files are written.

    files   those that are None or the standard output are left out
    raises  OutputClosedError, OSError: the result cannot be printed; its files are written
    """
    unheard: BaseException | None = None
    with answering() as interrupted:
        try:
            printed()
            sys.stdout.flush()
        except KeyboardInterrupt:
            pass
        except (OutputClosedError, OSError, SystemExit) as error:  # the last is rich's, of a pipe
            unheard = error
        with unhindered():
            troubles = [
                told
                for path, write in files
                if path is not None and path != STDOUT and (told := write_or_rescue(path, write))
            ]
            for told in troubles:
                print(told, file=sys.stderr)
    if unheard is not None:
        raise unheard
    if interrupted:
        raise typer.Exit(interrupted.code)
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
