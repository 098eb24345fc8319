"""Removes old recordings to make room for new ones; never one that is marked as kept."""

from __future__ import annotations

import json
import logging
import os
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cell.files.atomic import write_atomic
from cell.records.recording import form

_LOG = logging.getLogger(__name__)

#: A file of this name in a cycle's folder keeps its recording, whatever is in the file.
KEPT = "keep"
_DAY_S = 86_400.0


@dataclass(frozen=True)
class DiskRoom:
    """What recordings may take up; None = no limit.

    max_age_s       older recordings are removed
    max_bytes       of all recordings of a folder
    min_free_bytes  on the disk before a cycle
    """

    max_age_s: float | None = None
    max_bytes: float | None = None
    min_free_bytes: float = 0.0


@dataclass(frozen=True)
class _Known:
    path: Path
    bytes: int
    written_s: float


class Retention:
    """Keeps the recordings of one folder within their room.

    The folder is listed once; what is recorded afterwards is known.
    """

    def __init__(self, runs: Path, room: DiskRoom, *, only_stored: bool = False) -> None:
        """`only_stored`: recordings that are in no store yet are not removed either."""
        self._runs = runs
        self._room = room
        self._only_stored = only_stored
        self._known: deque[_Known] | None = None
        self._ended: list[Path] = []

    def make_room(self) -> str:
        """Remove the oldest recordings as far as needed; why there is no room, or "".

        Called between cycles.  A recording that cannot be removed is left out of account.
        """
        known = self._listed()
        for one in [k for k in known if not k.path.exists()]:  # removed by somebody else
            known.remove(one)
        removable = deque(k for k in known if self._removable(k.path.parent))
        total = sum(k.bytes for k in known)
        while removable and (why := self._too_much(removable[0], total)):
            oldest = removable.popleft()
            known.remove(oldest)
            total -= oldest.bytes
            try:
                remove_recording(oldest.path, why)
                _LOG.info("%s is removed: %s", oldest.path, why)
            except OSError as error:
                _LOG.warning("%s cannot be removed: %s", oldest.path, error.strerror)
        free = self._free_bytes()
        if free < self._room.min_free_bytes:
            return (
                f"{free / 1e9:.2f} GB are free on the disk of {self._runs}, "
                f"{self._room.min_free_bytes / 1e9:g} GB are needed; make room there, or lower "
                "recording.min_free_gb"
            )
        return ""

    def add(self, path: Path) -> None:
        """A recording was ended: it becomes a file soon, if it is kept."""
        self._ended.append(path)

    def _removable(self, folder: Path) -> bool:
        stored = not self._only_stored or (folder / form.STORED).exists()
        return stored and not (folder / KEPT).exists()

    def _listed(self) -> deque[_Known]:
        if self._known is None:
            files = self._runs.glob(f"*/{form.FILE}") if self._runs.is_dir() else ()
            found = [known for path in files if (known := _known(path)) is not None]
            self._known = deque(sorted(found, key=lambda k: k.written_s))
            return self._known
        unfinished = []
        for path in self._ended:
            begun = path.with_name(form.PART).exists()  # asked first: it gets its name meanwhile
            if (known := _known(path)) is not None:
                self._known.append(known)
            elif begun:
                unfinished.append(path)
        self._ended = unfinished
        return self._known

    def _too_much(self, oldest: _Known, total_bytes: int) -> str:
        """Why the oldest recording has to go; "" = it may stay."""
        room = self._room
        age_s = time.time() - oldest.written_s
        if room.max_age_s is not None and age_s > room.max_age_s:
            return f"it is {age_s / _DAY_S:.1f} days old"
        if room.max_bytes is not None and total_bytes > room.max_bytes:
            return f"recordings take {total_bytes / 1e9:.1f} GB"
        free = self._free_bytes()
        return f"{free / 1e9:.1f} GB are free" if free < room.min_free_bytes else ""

    def _free_bytes(self) -> int:
        place = self._runs
        while not place.exists():
            place = place.parent
        found = os.statvfs(place)
        return found.f_bavail * found.f_frsize


def remove_recording(path: Path, why: str) -> None:
    """Remove a recording, and say why in its cycle's folder.  Raises OSError: it is there still."""
    path.unlink(missing_ok=True)
    said = {"at": datetime.now().astimezone().isoformat(timespec="seconds"), "why": why}
    with suppress(OSError):  # the disk is full
        write_atomic(path.with_name(form.REMOVED), json.dumps(said, ensure_ascii=False))


def _known(path: Path) -> _Known | None:
    """A recording; None = it is not there, or not there any more."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return _Known(path, found.st_size, found.st_mtime)
