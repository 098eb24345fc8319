"""Atomic writes; files of secrets; room on a disk."""

from __future__ import annotations

import os
import shutil
import stat
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write `content` to the file at `path` atomically; parent folders are made.

    It is written to a file next to it and then renamed, so that a reader gets the former file or
    this one, and a full disk or a killed program leaves the former.  A link stays a link.

    raises  OSError: it cannot be written; nothing has changed
    """
    write_all({path: content})


def write_all(files: Mapping[Path, str | bytes]) -> None:
    """Write several files: all of them, or none where there is no room for one.

    They are renamed in the order of the mapping, once all are written.
    """
    parts: dict[Path, Path] = {}
    made: list[Path] = []
    path = Path()
    try:
        for path, content in files.items():
            target = path.resolve()
            made += [p for p in (target.parent, *target.parent.parents) if not p.exists()]
            target.parent.mkdir(parents=True, exist_ok=True)
            parts[target] = _part(target)
            parts[target].write_bytes(_bytes(content))
            with suppress(FileNotFoundError):  # it is new
                shutil.copymode(target, parts[target])
        for path in files:
            parts[path.resolve()].replace(path.resolve())
    except BaseException as error:
        _take_back([*parts.values()], made)
        if isinstance(error, OSError):  # which knows no name when a disk is full
            raise type(error)(error.errno, error.strerror, str(path)) from error
        raise


def write_new(path: Path, content: str | bytes) -> None:
    """As `write_atomic`, but never over a file.  Raises OSError, FileExistsError among them."""
    part = _part(path)
    try:
        part.write_bytes(_bytes(content))
        try:
            os.link(part, path)
        except FileExistsError:
            raise
        except OSError:  # a file system without hard links
            if path.exists():
                raise
            part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink()


def _part(path: Path) -> Path:
    """Path of a file before it is renamed; each thread has its own."""
    return path.with_name(f"{path.name}.{threading.get_native_id()}.part")


def _bytes(content: str | bytes) -> bytes:
    return content.encode("utf-8") if isinstance(content, str) else content


def _take_back(parts: list[Path], made: list[Path]) -> None:
    """Remove what was written, and folders that were made for it and are empty again."""
    for part in parts:
        with suppress(OSError):
            part.unlink()
    for folder in sorted(made, key=lambda p: -len(p.parts)):
        with suppress(OSError):
            folder.rmdir()


def named_folder(folder: Path) -> Path:
    """The folder with its own name: `.` and `..` are resolved.

    raises  ValueError: the root of the file system, which has no parent; or a file
    """
    if folder.is_file():
        raise ValueError(f"{folder}: is a file; give a folder")
    named = folder.resolve() if folder.name in ("", "..") else folder
    if not named.name:
        raise ValueError(
            f"{folder}: has no name, and files are written next to it; give another folder"
        )
    return named


def free_bytes(place: Path) -> int:
    """Free room on the disk of a folder, which need not exist yet."""
    place = place.absolute()
    while not place.exists():
        place = place.parent
    filesystem = os.statvfs(place)
    return filesystem.f_bavail * filesystem.f_frsize


def write_secret(path: Path, content: bytes) -> None:
    """Write `content` to the file at `path` atomically, readable by its owner only.

    raises  OSError: it cannot be written; nothing has changed
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(content)
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink()


def read_secret(path: Path, name: str) -> str:
    """First line of a file that only its owner may read.

    name    of the setting or option that gives the file, for messages
    raises  ValueError: it cannot be read, others may read it, or it is empty
    """
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        why = f"{error.strerror}; check the name and who may read it"
        raise ValueError(f"{name}: {path} cannot be read: {why}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{name}: {path} is not UTF-8 text; save it as UTF-8") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ValueError(
            f"{name}: others may use {path} (mode {stat.S_IMODE(mode):o}); `chmod 600 {path}`"
        )
    if not text.strip():
        raise ValueError(f"{name}: {path} is empty; write the secret into it")
    return text.splitlines()[0].strip()
