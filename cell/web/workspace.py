"""The lab's folder, next to the records: uploads, studies, results, effects; names, sizes, age.

Data from a browser are not trusted: no name leads out of the folder, no archive unpacks to more
than the limit, links are refused.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import time
import zipfile
import zlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import mkdtemp
from typing import IO

from cell.study.imports.read import KINDS

#: Suffixes of accepted files; `cell import` and studies read these.
SUFFIXES = frozenset({".yaml", ".yml", *KINDS})
#: Limits of one upload, unpacked: bytes, files, depth of folders.
MOST_UNPACKED, MOST_FILES, MOST_DEPTH = 256 << 20, 1200, 4
#: Limits of the workspace: bytes, and age after which files are removed, s.
MOST_BYTES, LONGEST_S = 2 << 30, 30 * 86400.0
#: Largest number of characters of a name.
LONGEST_NAME = 80
_PIECE = 1 << 20
_STUDY = "study.yaml"
#: Files of the operating system in folders and archives, which are ignored.
_LITTER = re.compile(r"^(\..*|__MACOSX|Thumbs\.db|desktop\.ini)$")
_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")


class UploadError(ValueError):
    """An upload is refused; the message names the file and the remedy."""


@dataclass(frozen=True)
class UploadResult:
    """Content of an upload: a study, or files for `cell import`."""

    name: str
    is_study: bool
    files: tuple[str, ...]


def is_name(name: str) -> bool:
    """Whether it may be the name of a study, a model or an effect in the workspace."""
    return bool(_NAME.match(name)) and len(name) <= LONGEST_NAME and not name.endswith(".")


def plain(name: str) -> str:
    """A name reduced to letters, digits, `_`, `-` and `.`, with its suffix; may be empty."""
    stem, dot, ending = name.rpartition(".")
    stem, ending = (stem, re.sub(r"[^A-Za-z0-9]+", "", ending)) if dot else (name, "")
    stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", stem).strip("._-")
    if not stem and not ending:
        return ""
    room = LONGEST_NAME - len(ending) - 1
    return f"{stem[:room] or 'file'}.{ending}" if ending else stem[:LONGEST_NAME]


def placed(name: str) -> PurePosixPath | None:
    """Path of an uploaded file in the folder of its upload; None = it is ignored.

    raises  UploadError: the name leads out of the folder, or its kind is refused
    """
    shown = ascii(name[:LONGEST_NAME])
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or re.match(r"^[A-Za-z]:", name) or "\0" in name:
        raise UploadError(f"{shown}: leads out of its folder; give names inside it")
    if any(_LITTER.match(part) for part in path.parts):
        return None
    if len(path.parts) > MOST_DEPTH:
        raise UploadError(f"{shown}: lies {len(path.parts)} folders deep; at most {MOST_DEPTH}")
    parts = [plain(part) for part in path.parts]
    if not parts or not all(parts):
        raise UploadError(f"{shown}: is no name of a file; rename it")
    if PurePosixPath(parts[-1]).suffix.lower() not in SUFFIXES:
        known = ", ".join(sorted(SUFFIXES))
        raise UploadError(f"{shown}: files of this kind are not taken; give {known}, or a .zip")
    return PurePosixPath(*parts)


class Workspace:
    """Folder of the lab's page; made when it is first written to.

    studies     a folder each
    uploads     files for `cell import`, a folder for each upload
    effects     typed effects
    candidates  models that `cell learn` proposes
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.studies, self.uploads = folder / "studies", folder / "uploads"
        self.effects, self.candidates = folder / "effects", folder / "candidates"

    @classmethod
    def of_runs(cls, runs: Path) -> Workspace:
        """Workspace of the cell whose records are in `runs`, by a short path if possible."""
        resolved = runs.resolve()
        folder = resolved.with_name(f"{resolved.name}.lab")
        here = Path.cwd()
        return cls(folder.relative_to(here) if folder.is_relative_to(here) else folder)

    def results(self, study: str) -> Path:
        """Folder of the results of a study, or of a recorded cycle, of this name."""
        return self.folder / "results" / study

    def names(self, folder: Path, suffix: str = "") -> list[str]:
        """Names of the entries of one of these folders, the newest first; without the suffix."""
        try:
            entries = [e for e in os.scandir(folder) if e.name.endswith(suffix) and is_name(e.name)]
        except OSError:
            return []
        entries.sort(key=lambda e: e.stat().st_mtime_ns, reverse=True)
        return [e.name.removesuffix(suffix) for e in entries]

    def uploaded(self, name: str) -> list[str]:
        """Files of an upload, by name; none if there is no such upload."""
        return sorted(self.names(self.uploads / name)) if is_name(name) else []

    def take(self, files: Sequence[tuple[str, IO[bytes]]]) -> UploadResult:
        """Store an upload: one archive, or files with their names relative to their folder.

        raises  UploadError: nothing is stored; OSError: there is no room
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        draft = Path(mkdtemp(prefix=".upload-", dir=self.folder))
        try:
            (draft / "files").mkdir()
            is_archive = len(files) == 1 and files[0][0].lower().endswith(".zip")
            names = _unpack(files[0][1], draft / "files") if is_archive else _copy(files, draft)
            if not names:
                raise UploadError("there is no file that could be read; give a study, or tables")
            return self._store(draft / "files", names, files[0][0] if is_archive else "")
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    def _store(self, files: Path, names: list[PurePosixPath], archive: str) -> UploadResult:
        studies = [name.parent for name in names if name.name == _STUDY]
        if len(studies) > 1:
            raise UploadError(f"{len(studies)} studies at once; upload one after another")
        top = files if not studies else files / studies[0]
        first = plain(PurePosixPath(archive or names[0].as_posix()).stem)
        common = names[0].parts[0] if len(names[0].parts) > 1 else first
        name = studies[0].name if studies and studies[0].name else common
        stored = tuple(n.as_posix() for n in names)
        if not studies:
            _flatten(files, names)
            stored = tuple(n.name for n in names)
        folder = _free(self.studies if studies else self.uploads, name or "upload")
        folder.parent.mkdir(parents=True, exist_ok=True)
        top.rename(folder)
        return UploadResult(folder.name, bool(studies), stored)

    def tidy(self, used: Collection[str] = ()) -> list[str]:
        """Remove old entries, then the oldest down to the size limit; names of the removed ones.

        used  names of studies and uploads in use, which stay
        """
        places = (self.studies, self.uploads, self.folder / "results")
        present = [p for place in places if place.is_dir() for p in place.iterdir()]
        drafts = self.folder.glob(".upload-*") if self.folder.is_dir() else ()
        ages = sorted((_age_s(p), p) for p in (*present, *drafts))
        sizes = {p: sum(f.lstat().st_size for f in _files(p) if f.exists()) for _, p in ages}
        total, removed = sum(sizes.values()), []
        for age_s, path in reversed(ages):
            stale = age_s > (3600.0 if path.name.startswith(".") else LONGEST_S)
            if path.name in used or not (stale or total > MOST_BYTES):
                continue
            shutil.rmtree(path, ignore_errors=True)
            total -= sizes[path]
            removed.append(path.name)
        return removed

    def inside(self, path: Path) -> bool:
        """Whether a path leads into the workspace, links followed."""
        return path.resolve().is_relative_to(self.folder.resolve())


def _copy(files: Sequence[tuple[str, IO[bytes]]], draft: Path) -> list[PurePosixPath]:
    remaining = [MOST_UNPACKED]
    names: list[PurePosixPath] = []
    if len(files) > MOST_FILES:
        raise UploadError(f"{len(files)} files; at most {MOST_FILES} at once")
    for file_name, content in files:
        if file_name.lower().endswith(".zip"):
            raise UploadError(f"{file_name[:LONGEST_NAME]!a}: give one archive, and it alone")
        if (name := placed(file_name)) is not None:
            _write(content, draft / "files", name, remaining)
            names.append(name)
    return names


def _unpack(archive: IO[bytes], folder: Path) -> list[PurePosixPath]:
    """Names of the files of an archive, unpacked.  Raises UploadError."""
    remaining, names = [MOST_UNPACKED], list[PurePosixPath]()
    try:
        with zipfile.ZipFile(archive) as opened:
            entries = [e for e in opened.infolist() if not e.is_dir()]
            if len(entries) > MOST_FILES:
                raise UploadError(f"the archive has {len(entries)} files; at most {MOST_FILES}")
            for entry in entries:
                if stat.S_ISLNK(entry.external_attr >> 16):
                    raise UploadError(f"{entry.filename!a}: is a link; put the file itself in")
                if (name := placed(entry.filename)) is not None:
                    with opened.open(entry) as content:
                        _write(content, folder, name, remaining)
                    names.append(name)
    except (
        zipfile.BadZipFile,
        RuntimeError,
        NotImplementedError,
        EOFError,
        zlib.error,
    ) as e:
        raise UploadError(f"the archive cannot be read: {e}; make it anew, as .zip") from e
    return names


def _write(content: IO[bytes], folder: Path, name: PurePosixPath, remaining: list[int]) -> None:
    """Copy a file as long as there is room: `remaining` has the bytes that may still be written."""
    path = folder / name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as file:
            while piece := content.read(_PIECE):
                remaining[0] -= len(piece)
                if remaining[0] < 0:
                    raise UploadError(
                        f"{name}: with it the upload has over {MOST_UNPACKED >> 20} MiB unpacked; "
                        "upload less at once"
                    )
                file.write(piece)
    except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        raise UploadError(f"{name}: two files have this name; rename one") from error


def _flatten(files: Path, names: Sequence[PurePosixPath]) -> None:
    """Move files out of their folders; `cell import` names trials after files."""
    if len({n.name for n in names}) < len(names):
        raise UploadError("two files in different folders have the same name; rename one")
    for name in names:
        if len(name.parts) > 1:
            (files / name).rename(files / name.name)
    for folder in {name.parts[0] for name in names if len(name.parts) > 1}:
        shutil.rmtree(files / folder)


def _free(folder: Path, name: str) -> Path:
    """An unused name: NAME, NAME-2, …"""
    numbers = iter(range(2, 10_000))
    path = folder / name
    while path.exists():
        path = folder / f"{name}-{next(numbers)}"
    return path


def _files(folder: Path) -> Iterator[Path]:
    return (Path(at) / name for at, _, names in os.walk(folder) for name in names)


def _age_s(folder: Path) -> float:
    """Time since the last change in it, s."""
    newest = max((f.lstat().st_mtime for f in _files(folder)), default=folder.lstat().st_mtime)
    return time.time() - max(newest, folder.lstat().st_mtime)
