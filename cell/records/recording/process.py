"""The recorder's process: takes messages of the cell's process from the ring and writes them.

    python -m cell.records.recording.process RING WAKE STATUS PRIORITY [FILE]

The first three arguments are file descriptors: of the shared memory, of a pipe that wakes it and
ends with the cell's process, and of a pipe for its reports, one JSON object per line.  PRIORITY is
`idle`, to run only while the processor is free, or `normal`.  FILE is the shared memory's file, if
it has one, which is removed at the end.  The process outlives the cell's until the content of the
ring is in the file.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from cell.computer.memory import reuse_freed_memory
from cell.records.recording.recorder import IDLE
from cell.records.recording.ring import RingReader
from cell.records.recording.writer import RecordingSession
from drivers.threads import GuardedThread, error_text

_NICE = 19
#: Least polling interval while other processes use the computer, s.
_LOOK_S = 0.001


class RingConsumer:
    """Reads the ring until the cell's process has ended."""

    def __init__(self, ring: RingReader, wake: int, status: int) -> None:
        self._ring = ring
        self._wake = wake
        self._status = status
        self._recording: RecordingSession | None = None
        self._parent_ended = False
        self._ending: list[GuardedThread] = []

    def run(self) -> None:
        """Write recordings; returns when the cell's process has ended and all is written."""
        while True:
            while self._ring.pause_until_s > time.monotonic() and not self._parent_ended:
                self._sleep(_LOOK_S)
            message = self._ring.take()
            if message is not None:
                self._act(*message)
                if self._recording is not None:
                    self._recording.keep_up()
                continue
            if self._recording is not None:
                self._recording.keep_up(now=True)
            if self._parent_ended:
                if self._recording is not None:
                    self._end(True, False)
                for thread in self._ending:
                    thread.join()
                return
            self._sleep(None)

    def _act(self, header: tuple[Any, ...], payload: bytes) -> None:
        match header:
            case ("begin", path, begun, vision):
                if self._recording is not None:
                    self._end(True, False)
                self._recording = RecordingSession(Path(path), begun, vision=vision)
            case ("end", keep, full):
                self._end(keep, True, full)
            case _ if self._recording is not None:
                self._recording.write(header, payload)

    def _end(self, keep: bool, complete: bool, full: bool = False) -> None:
        """Finish a recording in a thread, so that the next one need not wait."""
        recording, self._recording = self._recording, None
        if recording is None:
            return

        def finish() -> None:
            tell(recording.end(keep, complete, full))

        def torn(error: BaseException) -> None:
            tell({"path": str(recording.path), "error": error_text(error)})

        def tell(report: Mapping[str, Any]) -> None:
            with suppress(OSError):  # nobody listens any more
                os.write(self._status, (json.dumps(report) + "\n").encode())

        self._ending = [thread for thread in self._ending if thread.is_alive()]
        self._ending.append(GuardedThread("finish", finish, torn))
        self._ending[-1].start()

    def _sleep(self, seconds: float | None) -> None:
        """Wait until there is more, or the time has passed."""
        if seconds is not None:
            time.sleep(seconds)
        elif not os.read(self._wake, 65536):
            self._parent_ended = True


def main(ring: int, wake: int, status: int, priority: str, file: str | None = None) -> None:
    """Record until the other end of `wake` is closed."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):  # it ends with the cell's process
        signal.signal(number, signal.SIG_IGN)
    if priority == IDLE:
        with suppress(OSError):
            os.nice(_NICE)
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    RingConsumer(RingReader(ring), wake, status).run()
    if file is not None:
        Path(file).unlink(missing_ok=True)


if __name__ == "__main__":
    reuse_freed_memory()
    ring, wake, status = (int(argument) for argument in sys.argv[1:4])
    main(ring, wake, status, *sys.argv[4:])
