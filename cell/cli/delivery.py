"""A result is printed, then written: neither is lost because the other cannot be done."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import typer

from cell.cli.result_json import STDOUT
from cell.cli.shared import NOT_ALL_DONE, answering, unhindered
from cell.cli.streams import OutputClosedError
from cell.files.rescue import kept

#: A file, and what writes it to wherever it is told.
Delivery = tuple[Path | None, Callable[[Path], None]]


def deliver(printed: Callable[[], None], *files: Delivery) -> None:
    """Print a result, then write its files, whatever cannot be printed or written.

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
                if path is not None and path != STDOUT and (told := kept(path, write))
            ]
            for told in troubles:
                print(told, file=sys.stderr)
    if unheard is not None:
        raise unheard
    if interrupted:
        raise typer.Exit(interrupted.code)
    if troubles:
        raise typer.Exit(NOT_ALL_DONE)


def json_files(data: dict[str, Any], *places: Path | None) -> list[Delivery]:
    """A result as JSON in each file given."""
    from cell.lab.data.results import write_json

    return [(place, partial(write_json, data)) for place in places]
