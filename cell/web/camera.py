"""The camera's newest picture for all open pages, read twice a second while somebody looks."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cell.records.recording.growing import (
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
    """Keeps one picture, the newest: a browser that is slow misses those between.

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
