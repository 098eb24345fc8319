"""Reads text files from users, with a limit of size."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError

#: Size limit of JSON files, bytes: a model has some kilobytes.
MAX_JSON_BYTES = 10_000_000


def read_text(path: Path, max_bytes: int) -> str:
    """Text of a regular file in UTF-8, without a byte order mark.

    raises  InputError: it is missing, no regular file (a pipe would be waited for), no text, or
            larger than `max_bytes`
    """
    try:
        return read_bytes(path, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError.at(
            path, "cannot be read: is not UTF-8 text; save it as UTF-8", column=1
        ) from error


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Content of a regular file.  Raises InputError, as `read_text`."""
    try:
        state = path.stat()
        if not stat.S_ISREG(state.st_mode):
            kind = "a folder" if stat.S_ISDIR(state.st_mode) else "a pipe or a device"
            raise InputError.at(path, f"is {kind}; give the name of a text file", column=1)
        if state.st_size > max_bytes:
            raise InputError.at(
                path,
                f"has {state.st_size / 1e6:.3g} MB, limit {max_bytes / 1e6:g} MB; "
                "is this the file that is meant? Leave out what is not needed",
                column=1,
            )
        return path.read_bytes()
    except OSError as error:
        raise InputError.at(
            path, f"cannot be read: {error.strerror}; check the name and who may read it", column=1
        ) from error
    except ValueError as error:  # a name that no file can have
        if isinstance(error, InputError):
            raise
        message = f"cannot be read: {error}; check the name"
        raise InputError.at(path, message, column=1) from error


def known_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file; empty = the file is missing, damaged or something else."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) else {}


def read_json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.  Raises InputError: it cannot be read, or is something else."""
    text = read_text(path, MAX_JSON_BYTES)
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        message = f"is not JSON: {error.msg}; give a file as this program writes it"
        raise InputError.at(path, message, line=error.lineno, column=error.colno) from error
    except RecursionError as error:
        message = "is nested too deeply for what it may hold; give a file as this program writes it"
        raise InputError.at(path, message, column=1) from error
    if not isinstance(data, dict):
        raise InputError.at(path, "must hold one JSON object", column=1)
    return data
