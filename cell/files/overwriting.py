"""Which files a command may overwrite: those that a command wrote, others only with `--force`."""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

#: First bytes of files that commands write to paths of the user; the group names their format.
_OWN = re.compile(
    rb'\s*\{\s*"format": "((?:cable-|cell-|identified-)[a-z]+)/\d+"'
    rb"|format: (cell-(?:motion|candidate))/\d+\b"
    rb'|<!doctype (html)>\s*<html lang="en"><head><meta name="generator" content="cable-cell">'
    rb'|<(mujoco) model="cable">\s*<!--\s*A cable as \d+ hinges, exported from '
    rb'|"""(Law) inferred from the residuals of study '
    rb"|(started),ended,line,cycle,product,part,outcome,reason,"
)
#: Name of the format of a table of cycles.
_CYCLES = "started"
#: Formats of what a command writes to `-o`, `--json`, `--csv` and `--parquet`.
_WRITTEN = {
    "bundle": ("cable-bundle",),
    "compare": ("cable-comparison",),
    "diagnose": ("cable-diagnosis", "cable-together"),
    "discover": ("Law", "cable-discovery"),
    "effects": ("cable-effects",),
    "export": ("mujoco", "cable-model", "cable-export"),
    "fit": ("identified-cable",),
    "history": (_CYCLES,),
    "identify": ("identified-cable", "cable-identified"),
    "import": ("cable-imported", "cable-proposal"),
    "learn": ("cell-candidate", "cell-motion"),
    "look": ("html", "cable-look"),
    "power": ("cable-power",),
    "report": ("html",),
    "suggest": ("cell-motion", "cable-suggestion"),
}
#: Options that name an output, and those of them that name a page.
_PAGES = frozenset({"--report", "--profile"})
_OUTPUTS = _PAGES | {"-o", "--out", "--json", "--csv", "--parquet"}
#: Columns that only a table of cycles has; Parquet names its columns at the end of a file.
_OF_CYCLES = (b"acknowledged_note", b"prediction_error_m", b"fault_code")
_PARQUET, _MCAP, _ZIP = b"PAR1", b"\x89MCAP", b"PK\x03\x04"
_STUDY, _CYCLE = "study.yaml", "state.json"


class CommandLine:
    """What a command reads, and the formats of what it writes.

    name   of the command; "" = unknown: it writes any format
    words  after the name, as typed
    """

    def __init__(self, name: str = "", words: Sequence[str] = ()) -> None:
        self._name = name
        self._given: list[tuple[str, Path]] = []
        before = ""
        for word in words:
            option, equals, value = word.partition("=")
            if not word.startswith("-"):
                self._given.append((before, Path(word).resolve()))
            elif equals:
                self._given.append((option, Path(value).resolve()))
            before = word

    def inputs(self, outputs: Sequence[Path]) -> list[Path]:
        """Files and folders that the command may read, resolved."""
        written = {path.resolve() for path in outputs}
        return [p for option, p in self._given if not (option in _OUTPUTS and p in written)]

    def writes(self, path: Path, format_name: str) -> bool:
        """Whether the command writes files of a format to a path."""
        if any(option in _PAGES and p == path.resolve() for option, p in self._given):
            return format_name == "html"
        return not self._name or format_name in _WRITTEN.get(self._name, ())


def check_output(
    path: Path, *, force: bool | None = None, command: CommandLine | None = None
) -> None:
    """Check that a file can be written here, before the computation whose result it will hold.

    force    also over a file that no command wrote; None = the command has no `--force`
    command  which must not read this file; None = any
    raises   ValueError: there is a folder, a device, an input or a user's own file, or no right to
             write
    """
    command = command or CommandLine()
    inputs = command.inputs([path])
    check_not_read(path, inputs)
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; give the name of a file in it")
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: is a pipe or a device; give the name of a file")
    there = next(p for p in path.absolute().parents if p.exists())
    if not (there.is_dir() and os.access(there, os.W_OK)):
        raise ValueError(f"{path}: cannot be written, {there} is no folder that may be changed")
    protection = _why_protected(path, command) if path.exists() else ""
    is_read = force is not None and _is_read(path, inputs)
    if protection and (is_read or not force):
        remedy = "remove it" if force is None else "--force to overwrite it"
        reason = ", and this command reads its folder" if is_read else ""
        other = "give another name" if is_read else f"give another name, or {remedy}"
        raise ValueError(f"{path}: is there and {protection}{reason}; {other}")


def check_not_read(path: Path, inputs: Sequence[Path]) -> None:
    """Check that an output is no input, `--force` or not.  Raises ValueError: it is one."""
    if path.resolve() in inputs:
        raise ValueError(f"{path}: is read by this command; give the result another name")


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


def _record_of(path: Path) -> Path | None:
    """The study's or cycle's folder in which a file lies, resolved; None = there is none."""
    near = path.resolve().parents[:2]
    return next((p for p in near if (p / _STUDY).exists() or (p / _CYCLE).exists()), None)


def _is_read(path: Path, inputs: Sequence[Path]) -> bool:
    """Whether a file lies in the folder of a study or a cycle that is read."""
    folder = _record_of(path)
    return folder is not None and any(map(folder.is_relative_to, inputs))


def _why_protected(path: Path, command: CommandLine) -> str:
    """Why a file needs `--force` to be overwritten; "" = the command wrote it, or it is empty."""
    with path.open("rb") as file:
        start = file.read(200)
        if start.startswith(_MCAP):
            return "is a recording"
        if not start.strip():
            return ""
        format_name = _format_of(start, file)
    if not format_name:
        return "was not written by this program"
    folder = _record_of(path)
    if format_name != "html" and folder is not None and (folder / _CYCLE).exists():
        return "is part of a cycle's record"
    return "" if command.writes(path, format_name) else "holds a result of another kind"


def _format_of(start: bytes, file: BinaryIO) -> str:
    """Name of the format of a file that a command wrote; "" = none did."""
    if start.startswith(_ZIP):
        with suppress(zipfile.BadZipFile, KeyError, OSError), zipfile.ZipFile(file) as packed:
            start = packed.read("manifest.json")[:200]
    elif start.startswith(_PARQUET):
        length = file.seek(0, os.SEEK_END)
        file.seek(-8, os.SEEK_END)
        footer = int.from_bytes(file.read(4), "little") + 8
        file.seek(-min(footer, length), os.SEEK_END)
        columns = file.read()
        return _CYCLES if all(name in columns for name in _OF_CYCLES) else ""
    matched = _OWN.match(start)
    return next(filter(None, matched.groups())).decode() if matched else ""
