"""Pictures for the pages: the camera's newest, read while a page requests it, and film frames."""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from cell.records.recording import form
from cell.records.recording.film import FilmFrame, RecordedFilm, read_film, read_frame
from cell.records.recording.reading import (
    GrowingRecording,
    is_unrecorded,
    recording_under_way,
    small_jpeg,
)
from drivers.threads import GuardedThread

_LOG = logging.getLogger(__name__)

#: Least interval between two pictures, s.
EVERY_S = 0.5
#: Time without requests of pages after which reading stops, s.
_ASKED_S = 3.0
_WIDTH_PX = 640


@dataclass(frozen=True)
class LivePicture:
    """A picture of the cycle under way.

    number   grows with every picture
    taken_s  Unix time
    """

    number: int
    taken_s: float
    jpeg: bytes


class LiveCamera:
    """Holds the newest picture only: a slow browser misses earlier ones.

    unrecorded  the current cycle is not recorded
    """

    def __init__(self, runs: Path, now_s: Callable[[], float] = time.monotonic) -> None:
        self.newest: LivePicture | None = None
        self.unrecorded = False
        self._begins = False
        self._runs, self._now_s = runs, now_s
        self._growing: GrowingRecording | None = None
        self._requested_s = -_ASKED_S
        self._lock = threading.Lock()
        self._reading = False

    def ask(self) -> LivePicture | None:
        """The newest picture in memory; a newer one is then read in a thread."""
        with self._lock:
            self._requested_s = self._now_s()
            if not self._reading:
                self._reading = True
                GuardedThread("camera", self._read, self._died).start()
        return self.newest

    def read(self) -> None:
        """Read a newer picture now; without a current cycle there is none any more."""
        path = recording_under_way(self._runs)
        without = path is None and is_unrecorded(self._runs)
        self.unrecorded, self._begins = without and self._begins, without  # its file comes soon
        if path is None:
            self._growing = self.newest = None
            return
        if self._growing is None or self._growing.path != path:
            self._growing, self.newest = GrowingRecording(path), None
        try:
            frame, written_s = self._growing.newest(), path.stat().st_mtime
        except OSError:  # the cycle has just ended
            return
        if frame is not None:
            number = self.newest.number + 1 if self.newest else time.time_ns()
            self.newest = LivePicture(number, written_s - frame[0], small_jpeg(frame[1], _WIDTH_PX))

    def _died(self, error: BaseException) -> None:
        """Show no picture rather than an old one; the next request starts the thread again."""
        with self._lock:
            self._reading, self.newest = False, None

    def _read(self) -> None:
        while True:
            begun_s = self._now_s()
            try:
                self.read()
            except Exception:  # any error of the file: one picture is missing
                _LOG.exception("no picture of the cycle under way")
            time.sleep(max(0.0, EVERY_S - (self._now_s() - begun_s)))
            with self._lock:
                if self._now_s() - self._requested_s > _ASKED_S:
                    self._reading = False
                    return


#: Largest width of a served frame, px.
WIDTH_PX = 960
#: Size of the cache, bytes.
MOST_BYTES = 16 << 20
#: Number of cached indexes of films.
_FILMS = 8
#: Number of frames that are read at the same time, however many are requested.
_AT_ONCE = 2

_FrameKey = tuple[Path, int, int]


class Films:
    """Frames by cycle and number; safe to be used from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._busy = threading.BoundedSemaphore(_AT_ONCE)
        self._newest: dict[_FrameKey, FilmFrame] = {}  # of a film: the next one is near
        self._frames: OrderedDict[tuple[_FrameKey, int], bytes] = OrderedDict()
        self.bytes = 0

    def film(self, folder: Path) -> RecordedFilm:
        """Frames of a cycle's recording.  Raises OSError: it has none; InputError."""
        return self._film(folder)[1]

    def frame(self, folder: Path, number: int) -> bytes:
        """A frame as JPEG, with the detected cable.

        raises  OSError, IndexError: there is none; InputError: it cannot be read
        """
        known, film = self._film(folder)
        if not 0 <= number < len(film.stamps_ns):
            raise IndexError(number)
        with self._lock:
            if (cached := self._frames.get((known, number))) is not None:
                self._frames.move_to_end((known, number))
                return cached
        with self._busy:
            frame = read_frame(film, number, self._newest.get(known))
            made = frame.jpeg(WIDTH_PX)
        with self._lock:
            self._newest[known] = frame
            while len(self._newest) > _AT_ONCE:
                self._newest.pop(next(iter(self._newest)))
            if (known, number) not in self._frames:
                self._frames[known, number] = made
                self.bytes += len(made)
            while self.bytes > MOST_BYTES and len(self._frames) > 1:
                self.bytes -= len(self._frames.popitem(last=False)[1])
        return made

    def _film(self, folder: Path) -> tuple[_FrameKey, RecordedFilm]:
        path = folder / form.FILE
        status = path.stat()
        known = (path, status.st_mtime_ns, status.st_size)
        return known, _known_film(*known)


@lru_cache(_FILMS)
def _known_film(path: Path, stamp_ns: int, size_bytes: int) -> RecordedFilm:
    """Frames of a recording, cached until it changes."""
    return read_film(path)
