"""What a command is given: folders of cycles, and recordings, which stand for their folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from tempfile import TemporaryDirectory

import typer

from cell.cli.shared import refuse
from cell.files.named import named_folder

#: How the file of a recording ends.
RECORDING = ".mcap"


def folder_of(ctx: typer.Context, given: Path) -> Path:
    """The folder itself, or one with what a recording holds, until the command ends."""
    return folder_in(ctx.with_resource, given)


def records_folder(given: Path) -> Path:
    """A folder of records, beside which log, ledger and socket have their places."""
    try:
        return named_folder(given)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error


def maybe_folder_of(ctx: typer.Context, given: Path | None) -> Path | None:
    """The same of what may be left out."""
    return None if given is None else folder_of(ctx, given)


def folders_of(ctx: typer.Context, given: Sequence[Path]) -> list[Path]:
    """The same for several."""
    return [folder_of(ctx, path) for path in given]


def folder_in(enter: Callable[[AbstractContextManager[str]], str], given: Path) -> Path:
    """The folder itself, or one with what a recording holds; `enter` says until when."""
    if given.suffix != RECORDING:
        return given
    from cell.files.input_error import InputError
    from cell.records.recording.reading import read_recording
    from cell.records.recording.unpack import unpack

    folder = TemporaryDirectory()
    into = Path(enter(folder))
    try:
        return unpack(read_recording(given), into)
    except InputError as error:
        folder.cleanup()  # while arguments are read the command has not begun, nor does it end
        refuse(error)
