"""Removes recordings to make room for new ones, except those that are marked as protected.

First go full frames that are also stored as bands, then the oldest recordings of inserted cables,
and last those that are likely to be needed: `RecordingSettings.last_removed_every`.
"""

from __future__ import annotations

import json
import logging
import statistics
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from datetime import time as time_of_day
from enum import IntEnum
from itertools import islice
from pathlib import Path

from cell.files.atomic import free_bytes, write_atomic
from cell.files.text_file import known_json
from cell.records.folder import cycle_of, started_of
from cell.records.ledger.effectiveness import shift_start
from cell.records.recording import form
from cell.records.result import Outcome
from cell.settings.records import RecordingSettings

_LOG = logging.getLogger(__name__)

#: A file of this name in a cycle's folder protects its recording; its content is ignored.
KEPT = "keep"
_DAY_S = 86_400.0
_NAMES = form.WHOLE, form.FILE


class _Rank(IntEnum):
    """Order of removal."""

    WHOLE_FRAMES = 0
    USUAL = 1
    LAST = 2


@dataclass(frozen=True)
class _Known:
    path: Path
    bytes: int
    written_s: float
    rank: _Rank

    @property
    def order(self) -> tuple[int, float]:
        return self.rank, self.written_s


class Retention:
    """Removes recordings of a folder until the others fit into their room.

    The folder is listed once; later recordings are added to this list.

    wanted  limits; if it names a store, recordings that are not in it yet are not removed either
    shifts  when shifts begin, local time: the first cycle of each is removed after all others
    """

    def __init__(
        self, runs: Path, wanted: RecordingSettings, shifts: Sequence[time_of_day] = ()
    ) -> None:
        self._runs = runs
        self._wanted = wanted
        self._begins = shifts
        self._known: list[_Known] | None = None
        self._ended: list[Path] = []
        self._shifts: set[datetime] = set()

    def make_room(self) -> str:
        """Remove the oldest recordings as far as needed; why there is no room, or "".

        Called between cycles.  A recording that cannot be removed is ignored.
        """
        known = self._list_all()
        for recording in [k for k in known if not k.path.exists()]:  # removed by somebody else
            known.remove(recording)
        total = sum(k.bytes for k in known)
        for recording in sorted(known, key=lambda k: k.order):
            why = self._too_old(recording) or self._too_much(total)
            if not why or not self._removable(recording):
                continue
            known.remove(recording)
            total -= recording.bytes
            try:
                self._remove(recording, why)
                _LOG.info("%s is removed: %s", recording.path, why)
            except OSError as error:
                _LOG.warning("%s cannot be removed: %s", recording.path, error.strerror)
        free = free_bytes(self._runs)
        if free < self._wanted.min_free_gb * 1e9:
            return (
                f"{free / 1e9:.2f} GB are free on the disk of {self._runs}, "
                f"{self._wanted.min_free_gb:g} GB are needed; make room there, or lower "
                "recording.min_free_gb"
            )
        return ""

    def add(self, path: Path) -> None:
        """Register a recording that has ended: it becomes a file soon, unless it is discarded."""
        self._ended.append(path)

    def _removable(self, recording: _Known) -> bool:
        folder = recording.path.parent
        stored = self._wanted.store is None or (folder / form.STORED).exists()
        again = recording.rank is _Rank.WHOLE_FRAMES
        return (stored or again) and not (folder / KEPT).exists()

    def _remove(self, recording: _Known, why: str) -> None:
        if recording.rank is _Rank.WHOLE_FRAMES:  # the recording is there still
            recording.path.unlink(missing_ok=True)
        else:
            remove_recording(recording.path, why)

    def _list_all(self) -> list[_Known]:
        if self._known is None:
            there = self._runs.is_dir()
            paths = (p for name in _NAMES for p in self._runs.glob(f"*/{name}")) if there else ()
            self._known = [k for path in sorted(paths, key=_status_of) for k in self._rank(path)]
            return self._known
        unfinished = []
        for path in self._ended:
            begun = path.with_name(form.PART).exists()  # checked first: it is renamed meanwhile
            ranked = [k for name in _NAMES for k in self._rank(path.with_name(name))]
            self._known += ranked
            if not ranked and begun:
                unfinished.append(path)
        self._ended = unfinished
        return self._known

    def _rank(self, path: Path) -> list[_Known]:
        """A recording with its rank; empty if it does not exist."""
        written_s, size = _status_of(path)
        if not written_s:
            return []
        if path.name == form.WHOLE:
            rank = _Rank.WHOLE_FRAMES
        else:
            rank = _Rank.LAST if self._is_last(path.parent) else _Rank.USUAL
        return [_Known(path, size, written_s, rank)]

    def _is_last(self, folder: Path) -> bool:
        """Whether a cycle's recording is removed after all others."""
        cycle, every = cycle_of(folder), self._wanted.last_removed_every
        if cycle is None:
            return False
        first = False
        if self._begins:
            shift = shift_start(self._begins, started_of(folder, None))
            first = shift not in self._shifts
            self._shifts.add(shift)
        outcome = known_json(folder / "result.json").get("outcome")
        return first or (every > 0 and cycle % every == 0) or outcome != Outcome.INSERTED.value

    def _too_old(self, recording: _Known) -> str:
        """Why a recording must be removed for its age; "" = it may stay."""
        age_s = time.time() - recording.written_s
        days = self._wanted.max_age_days
        old = days is not None and age_s > days * _DAY_S
        return f"it is {age_s / _DAY_S:.1f} days old" if old else ""

    def _too_much(self, total_bytes: int) -> str:
        """Why recordings must be removed for their size; "" = there is room for all."""
        size_gb = self._wanted.max_size_gb
        if size_gb is not None and total_bytes > size_gb * 1e9:
            return f"recordings take {total_bytes / 1e9:.1f} GB"
        free = free_bytes(self._runs)
        return f"{free / 1e9:.1f} GB are free" if free < self._wanted.min_free_gb * 1e9 else ""


#: Frames of a usual cycle, and stored bytes per pixel: of a band, and of full frames.
_FRAMES, _OF_BAND, _OF_WHOLE = 550, 0.025, 0.63
#: Default time of a cycle, s.
_CYCLE_S = 10.0
#: Number of the newest recordings from which the size of the next is estimated.
_NEWEST = 20


@dataclass(frozen=True)
class RecordingRoom:
    """Number of recordings that fit, and its inputs.

    cycle_bytes  of one recording: the mean of the newest ones, else a default
    cycle_s      time of one cycle: the median of the newest ones, else 10 s
    bytes        available to recordings, by limit and disk
    limit_bytes  the same by the settings alone; None = no limit
    """

    cycle_bytes: float
    cycle_s: float
    bytes: float
    limit_bytes: float | None

    @property
    def cycles(self) -> int:
        """Recordings that fit."""
        return int(self.bytes / self.cycle_bytes)

    @property
    def hours(self) -> float:
        """Hours of uninterrupted work that fit."""
        return self.cycles * self.cycle_s / 3600.0

    def __str__(self) -> str:
        return (
            f"{self.cycles:,} recordings of {self.cycle_bytes / 1e6:.0f} MB, {self.hours:.1f} h of "
            f"work at {self.cycle_s:.0f} s a cable"
        )


def recording_room(runs: Path, wanted: RecordingSettings, pixels: int) -> RecordingRoom:
    """How many recordings fit into the folder of the records, by those of whole insertions.

    pixels  of a frame
    """
    files = sorted(runs.glob(f"*/{form.FILE}"), key=_status_of) if runs.is_dir() else []
    whole = ((path, _cycle_s(path.parent)) for path in reversed(files))
    newest = list(islice(((path, s) for path, s in whole if s is not None), _NEWEST))
    sizes = [size for path, _ in newest if (size := _status_of(path)[1])]
    usual = _FRAMES * pixels * (_OF_WHOLE if wanted.whole_frames else _OF_BAND)
    times = [s for _, s in newest]
    used = sum(_status_of(path)[1] for name in _NAMES for path in runs.glob(f"*/{name}"))
    limit_bytes = None if wanted.max_size_gb is None else wanted.max_size_gb * 1e9
    on_disk = max(0.0, free_bytes(runs) + used - wanted.min_free_gb * 1e9)
    return RecordingRoom(
        sum(sizes) / len(sizes) if sizes else usual,
        statistics.median(times) if times else _CYCLE_S,
        on_disk if limit_bytes is None else min(on_disk, limit_bytes),
        limit_bytes,
    )


def _cycle_s(folder: Path) -> float | None:
    """Duration of a cycle that was executed to its end; None = it was not, or is not known."""
    try:
        result = known_json(folder / "result.json")
        if result["outcome"] not in (Outcome.INSERTED, Outcome.MISSED, Outcome.MEASURED):
            return None
        return float(sum(result["seconds"].values()))
    except (KeyError, TypeError, AttributeError):
        return None


def remove_recording(path: Path, why: str) -> None:
    """Remove a recording, its full frames too, and write the reason to its cycle's folder.

    raises  OSError: it is there still
    """
    for name in _NAMES:
        path.with_name(name).unlink(missing_ok=True)
    removal = {"at": datetime.now().astimezone().isoformat(timespec="seconds"), "why": why}
    with suppress(OSError):  # the disk is full
        write_atomic(path.with_name(form.REMOVED), json.dumps(removal, ensure_ascii=False))


def _status_of(path: Path) -> tuple[float, int]:
    """Unix time of a file's last change, and its bytes; 0 = it does not exist any more."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return 0.0, 0
    return status.st_mtime, status.st_size
