"""Writes a whole settings file, and keeps the files that it has replaced."""

from __future__ import annotations

import threading
from pathlib import Path

from cell.files.atomic import write_whole
from cell.settings.promotion import next_entry, read_exactly

_LOCK = threading.Lock()


class ChangedMeanwhileError(Exception):
    """The file is not as it was when it was read.  Scenario: an editor has saved it since.

    text  what is in it now
    """

    def __init__(self, text: str) -> None:
        super().__init__("the file was changed meanwhile")
        self.text = text


def versions_folder(config: Path) -> Path:
    """Folder of the settings as they were before each writing."""
    return config.with_name(f"{config.stem}.settings")


def versions(config: Path) -> tuple[Path, ...]:
    """Files that were replaced, the newest first."""
    return tuple(sorted(versions_folder(config.resolve()).glob("[0-9]*.yaml"), reverse=True))


def replace_settings(config: Path, before: str, after: str) -> Path:
    """Write settings, whole or not at all; the former file is kept first.

    before   text that the file must have still
    returns  where the former file is kept
    raises   ChangedMeanwhileError; OSError: it cannot be written; the file is as it was
    """
    config = config.resolve()
    with _LOCK:
        present = read_exactly(config)
        if present != before:
            raise ChangedMeanwhileError(present)
        entry = next_entry(versions_folder(config))
        write_whole(entry, before.encode())
        write_whole(config, after.encode())
    return entry
