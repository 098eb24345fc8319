"""Frames of past cycles as JPEG: few at a time, and the newest kept in memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path

from cell.records.recording import form
from cell.records.recording.film import RecordedFilm, frame_jpeg, read_film

#: Frames are served at most so wide, px.
WIDTH_PX = 960
#: So much is kept in memory, bytes.
MOST_BYTES = 16 << 20
#: Indexes of so many films are kept.
_FILMS = 8
#: So many frames are read at a time, whatever browsers ask for.
_AT_ONCE = 2

_Known = tuple[Path, int, int]


class Films:
    """Frames by cycle and number; safe to be used from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._busy = threading.BoundedSemaphore(_AT_ONCE)
        self._films: OrderedDict[_Known, RecordedFilm] = OrderedDict()
        self._frames: OrderedDict[tuple[_Known, int], bytes] = OrderedDict()
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
            made = frame_jpeg(film, number, WIDTH_PX)
        with self._lock:
            if (known, number) not in self._frames:
                self._frames[known, number] = made
                self.bytes += len(made)
            while self.bytes > MOST_BYTES and len(self._frames) > 1:
                self.bytes -= len(self._frames.popitem(last=False)[1])
        return made

    def _film(self, folder: Path) -> tuple[_Known, RecordedFilm]:
        path = folder / form.FILE
        found = path.stat()
        known = (path, found.st_mtime_ns, found.st_size)
        with self._lock:
            if (film := self._films.get(known)) is not None:
                return known, film
        with self._busy:
            film = read_film(path)
        with self._lock:
            self._films[known] = film
            while len(self._films) > _FILMS:
                self._films.popitem(last=False)
        return known, film
