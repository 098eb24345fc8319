"""Which files a command may overwrite: those that a command wrote, others only with `--force`."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

#: First bytes of files that commands write to paths of the user.
_OWN = re.compile(
    rb'\s*\{\s*"format": "(?:cable-|cell-|identified-)[a-z]+/\d+"'
    rb"|format: cell-(?:motion|candidate)/\d+\b"
    rb'|<!doctype html>\s*<html lang="en"><head><meta name="generator" content="cable-cell">'
    rb'|<mujoco model="cable">\s*<!--\s*A cable as \d+ hinges, exported from '
    rb'|"""Law inferred from the residuals of study '
    rb"|started,ended,line,cycle,product,part,outcome,reason,"
)
#: Columns that only a table of cycles has; Parquet names its columns at the end of a file.
_OF_CYCLES = (b"acknowledged_note", b"prediction_error_m", b"fault_code")
_PARQUET, _MCAP = b"PAR1", b"\x89MCAP"


def check_output(path: Path, *, force: bool | None = None) -> None:
    """Check that a file can be written here, before the computation whose result it will hold.

    force   also over a file that no command wrote; None = the command has no `--force`
    raises  ValueError: there is a folder, a device or a user's own file, or no right to write
    """
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; give the name of a file in it")
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: is a pipe or a device; give the name of a file")
    there = next(p for p in path.absolute().parents if p.exists())
    if not (there.is_dir() and os.access(there, os.W_OK)):
        raise ValueError(f"{path}: cannot be written, {there} is no folder that may be changed")
    if path.exists() and not force and (protection := _why_protected(path)):
        remedy = "remove it" if force is None else "--force to overwrite it"
        raise ValueError(f"{path}: is there and {protection}; give another name, or {remedy}")


def check_distinct(paths: Sequence[Path]) -> None:
    """Check that no two paths are the same file.  Raises ValueError: one would replace another.

    Scenario: `--report a.html -o a.html`.
    """
    places = [path.resolve() for path in paths]
    for i, path in enumerate(paths):
        if places[i] in places[:i]:
            raise ValueError(f"{path}: is given for two results; give each a name of its own")


def check_new_study(folder: Path, *, force: bool = False) -> None:
    """Check that a study can be written here.  Raises ValueError: there is one, or a file."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: is a file; give the name of a folder")
    if (folder / "study.yaml").exists() and not force:
        raise ValueError(
            f"{folder}: holds a study already; give another folder, or --force to overwrite it"
        )


def _why_protected(path: Path) -> str:
    """Why a file needs `--force` to be overwritten; "" = a command wrote it, or it is empty."""
    with path.open("rb") as file:
        start = file.read(200)
        if start.startswith(_MCAP):
            return "is a recording"
        if not start.strip() or _OWN.match(start):
            return ""
        if start.startswith(_PARQUET):
            file.seek(-8, os.SEEK_END)
            footer = int.from_bytes(file.read(4), "little") + 8
            file.seek(-min(footer, path.stat().st_size), os.SEEK_END)
            columns = file.read()
            if all(name in columns for name in _OF_CYCLES):
                return ""
    return "was not written by this program"
