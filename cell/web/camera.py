"""Pictures for the pages: the camera's newest, read while somebody looks, and frames of films."""

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

#: A picture is read at most so often, s.
EVERY_S = 0.5
#: When no page has asked for so long, s, nothing is read.
_ASKED_S = 3.0
_WIDTH_PX = 640


@dataclass(frozen=True)
class LivePicture:
    """A picture of the cycle under way.

    number   grows with every picture
    taken_s  when, Unix time
    """

    number: int
    taken_s: float
    jpeg: bytes


class LiveCamera:
    """Holds the newest picture only: a slow browser misses the ones between.

    unrecorded  the cycle under way is not recorded
    """

    def __init__(self, runs: Path, now_s: Callable[[], float] = time.monotonic) -> None:
        self.newest: LivePicture | None = None
        self.unrecorded = False
        self._begins = False
        self._runs, self._now_s = runs, now_s
        self._growing: GrowingRecording | None = None
        self._asked_s = -_ASKED_S
        self._lock = threading.Lock()
        self._reading = False

    def ask(self) -> LivePicture | None:
        """The newest picture that is known; a newer one is read meanwhile, in a thread."""
        with self._lock:
            self._asked_s = self._now_s()
            if not self._reading:
                self._reading = True
                GuardedThread("camera", self._read, self._died).start()
        return self.newest

    def read(self) -> None:
        """Look for a newer picture now; without a cycle under way there is none any more."""
        path = recording_under_way(self._runs)
        without = path is None and is_unrecorded(self._runs)
        self.unrecorded, self._begins = without and self._begins, without  # its file comes soon
        if path is None:
            self._growing = self.newest = None
            return
        if self._growing is None or self._growing.path != path:
            self._growing, self.newest = GrowingRecording(path), None
        try:
            found, written_s = self._growing.newest(), path.stat().st_mtime
        except OSError:  # the cycle has just ended
            return
        if found is not None:
            number = self.newest.number + 1 if self.newest else time.time_ns()
            self.newest = LivePicture(number, written_s - found[0], small_jpeg(found[1], _WIDTH_PX))

    def _died(self, error: BaseException) -> None:
        """No picture rather than an old one; the next page that asks has it read again."""
        with self._lock:
            self._reading, self.newest = False, None

    def _read(self) -> None:
        while True:
            begun_s = self._now_s()
            try:
                self.read()
            except Exception:  # a picture less, whatever is wrong with the file
                _LOG.exception("no picture of the cycle under way")
            time.sleep(max(0.0, EVERY_S - (self._now_s() - begun_s)))
            with self._lock:
                if self._now_s() - self._asked_s > _ASKED_S:
                    self._reading = False
                    return


#: Frames are served at most so wide, px.
WIDTH_PX = 960
#: So much is kept in memory, bytes.
MOST_BYTES = 16 << 20
#: Indexes of so many films are kept.
_FILMS = 8
#: So many frames are read at a time, whatever browsers ask for.
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
        """A frame as JPEG, with the cable as it was seen.

        raises  OSError, IndexError: there is none; InputError: it cannot be read
        """
        known, film = self._film(folder)
        if not 0 <= number < len(film.stamps_ns):
            raise IndexError(number)
        with self._lock:
            if (found := self._frames.get((known, number))) is not None:
                self._frames.move_to_end((known, number))
                return found
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
        found = path.stat()
        known = (path, found.st_mtime_ns, found.st_size)
        return known, _known_film(*known)


@lru_cache(_FILMS)
def _known_film(path: Path, stamp_ns: int, size_bytes: int) -> RecordedFilm:
    """Frames of a recording as long as it is not written to."""
    return read_film(path)
