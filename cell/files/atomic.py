"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def write_whole(path: Path, content: str | bytes) -> None:
    """Make `content` the file at `path`, whole or not at all; folders above it are made.

    It is written beside the file and then takes its place, so that a reader meets the former file
    or this one, and a full disk or a killed program leaves the former.  A link stays a link.

    raises  OSError: it cannot be written; nothing has changed
    """
    target = path.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    data = content.encode("utf-8") if isinstance(content, str) else content
    try:
        part.write_bytes(data)
        part.replace(target)
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):  # which knows no name when a disk is full
            raise type(error)(error.errno, error.strerror, str(path)) from error
        raise
