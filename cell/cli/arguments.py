"""Arguments of commands: folders of cycles, or recordings, which are unpacked; ids of cables."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import MISSING, fields
from inspect import Parameter, Signature
from itertools import repeat
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from cell.cli.shared import refuse, tell_notes
from cell.files.atomic import named_folder

if TYPE_CHECKING:
    from cell.workers.executor import Executor


def taking(kind: type[Any]) -> Callable[[Callable[[Any], None]], Callable[..., None]]:
    """Turn a command that takes a frozen dataclass into one whose typer options are its fields.

    Every field is annotated as typer wants a parameter to be.
    """
    hints = get_type_hints(kind, include_extras=True)
    options = [
        Parameter(
            field.name,
            Parameter.KEYWORD_ONLY,
            default=Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(kind)
    ]

    def made(command: Callable[[Any], None]) -> Callable[..., None]:
        def called(**values: Any) -> None:
            command(kind(**values))

        called.__name__, called.__doc__ = command.__name__, command.__doc__
        called.__module__ = command.__module__
        called.__signature__ = Signature(options)  # type: ignore[attr-defined]
        called.__annotations__ = {o.name: o.annotation for o in options}
        return called

    return made


#: How the file of a recording ends.
RECORDING = ".mcap"


def folder_of(ctx: typer.Context, given: Any) -> Any:
    """A path or several; in place of a recording a temporary folder, until the command ends."""
    if given is None or isinstance(given, Path):
        return given and folder_in(ctx.with_resource, given)
    return [folder_in(ctx.with_resource, path) for path in given]


def records_folder(folder: Path) -> Path:
    """A folder of records by its name; log, ledger and socket are placed next to it."""
    try:
        return named_folder(folder)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error


Runs = Annotated[
    Path,
    typer.Option(
        "--runs", help="Folder of the cell's records: its --runs.", callback=records_folder
    ),
]

RunsFolder = Annotated[
    Path, typer.Argument(help="Folder of the cycles: that of `cell run --runs`.")
]


def folder_in(enter: Callable[[AbstractContextManager[str]], str], path: Path) -> Path:
    """The folder itself; for a recording a temporary one, which `enter` adds to a context."""
    if path.suffix != RECORDING:
        return path
    from cell.files.input_error import InputError
    from cell.records.recording.reading import read_recording
    from cell.records.recording.unpack import unpack

    folder = TemporaryDirectory()
    into = Path(enter(folder))
    try:
        return unpack(read_recording(path), into)
    except InputError as error:
        folder.cleanup()  # while arguments are read the command has not begun, nor does it end
        refuse(error)


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
def workers(option: str | None, config: Path | None = None) -> Iterator[Executor]:
    """The executor for a command's jobs.

    option  value of the option; None = that of the settings
    raises  WorkersError; InputError: the settings are wrong
    """
    from cell.workers.executor import place
    from cell.workers.here import executor

    where = _of_settings(config) if option is None else place(option)
    with executor(where, lambda note: tell_notes([note])) as pool:
        yield pool


def _of_settings(config: Path | None) -> str | int | None:
    if config is None:
        return None
    from cell.settings import load_settings

    section = load_settings(config).workers
    return None if section is None else section.place


#: Longest id, as the ledger has room for it.
LONGEST_ID = 200


#: Ids are read from standard input, where a scanner types them.
SCANNED = "-"


def part_ids(option: str | None) -> Iterator[str | None]:
    """Ids of successive cables; None = they have none.

    option  an id whose last digits count on, or `SCANNED`; None = no ids
    raises  ValueError: no id
    """
    if option is None:
        return repeat(None)
    return _scanned_ids() if option == SCANNED else _consecutive_ids(checked_id(option))


def checked_id(part: str) -> str:
    """The id, stripped.  Raises ValueError: it is empty, too long or not printable."""
    part = part.strip()
    if not part or not part.isprintable() or len(part) > LONGEST_ID:
        raise ValueError(f"{part!r} is no id; give 1 to {LONGEST_ID} printable characters")
    return part


def _consecutive_ids(first: str) -> Iterator[str]:
    matched = re.fullmatch(r"(.*?)(\d*)", first)
    assert matched is not None
    stem, digits = matched[1], matched[2]
    yield first
    if not digits:  # the first is followed by a second of its name
        stem, digits = f"{first}-", "1"
    number = int(digits)
    while True:
        number += 1
        yield f"{stem}{number:0{len(digits)}d}"


def _scanned_ids() -> Iterator[str]:
    while line := sys.stdin.readline():
        try:
            part = checked_id(line)
        except ValueError as error:
            print(f"{error}; scan it again", file=sys.stderr)
            continue
        yield part
