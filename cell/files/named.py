"""Folders that have files beside them, with the same name and an ending."""

from __future__ import annotations

from pathlib import Path


def named_folder(folder: Path) -> Path:
    """The folder by its name: `.` and `..` become what they stand for.

    raises  ValueError: the root of the file system, beside which there is no place; or a file
    """
    if folder.is_file():
        raise ValueError(f"{folder}: is a file; give a folder")
    named = folder.resolve() if folder.name in ("", "..") else folder
    if not named.name:
        raise ValueError(f"{folder}: has no name, and files stand beside it; give another folder")
    return named
