"""Where a command's independent jobs are done: its option, and the settings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.cli.shared import tell_notes

if TYPE_CHECKING:
    from cell.workers.executor import Executor

Workers = Annotated[
    str | None,
    typer.Option(
        "--workers",
        help="Workers of a Dask cluster, by its scheduler's address (tcp://host:8786), or a number "
        "of cores of this computer.  Default: `workers` in the settings, or all cores.",
        metavar="WHERE",
        show_default=False,
    ),
]


@contextmanager
def workers(given: str | None, config: Path | None = None) -> Iterator[Executor]:
    """The executor for a command's jobs.

    given   as the option says; None = as the settings say
    raises  WorkersError; InputError: the settings are wrong
    """
    from cell.workers.opened import executor
    from cell.workers.place import place

    where = _of_settings(config) if given is None else place(given)
    with executor(where, lambda note: tell_notes([note])) as found:
        yield found


def _of_settings(config: Path | None) -> str | int | None:
    if config is None:
        return None
    from cell.settings import load_settings

    said = load_settings(config).workers
    return None if said is None else said.place
