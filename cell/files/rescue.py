"""Saves results that cannot be written to their file in the folder of temporary files."""

from __future__ import annotations

import errno
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

#: Error numbers of a full disk or quota, and of a file that may not grow.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def no_room(error: OSError) -> bool:
    """Whether a file could not be written for want of room."""
    return error.errno in NO_ROOM


def remedy(error: OSError) -> str:
    """Remedy for a file that cannot be read or written."""
    if no_room(error):
        return "make room there, or name another disk"
    return "check the name and who may read and write there"


def why_not_written(error: OSError) -> str:
    """Message about a file that could not be written."""
    if error.errno is None:  # in words already
        return str(error)
    name = error.filename2 or error.filename
    cause = error.strerror if name is None else f"{name}: {error.strerror}"
    return f"{cause}; {remedy(error)}"


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add `path` to an OSError that names no file, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from error


def write_or_rescue(path: Path, write: Callable[[Path], object]) -> str:
    """Write a file to its path; if that fails, a copy to the folder of temporary files.

    write    writes it to a path, atomically
    returns  message for a person; empty = it was written to its path
    """
    try:
        write(path)
    except OSError as error:
        why, todo = f"{path}: cannot be written: {error.strerror or error}", remedy(error)
    else:
        return ""
    with suppress(OSError):
        copy = Path(tempfile.mkdtemp(prefix="cell-")) / path.name
        try:
            write(copy)
        except OSError:
            copy.parent.rmdir()
        else:
            return f"{why}; it is kept as {copy}: copy it from there"
    return f"{why}; {todo}, and give the command again"
