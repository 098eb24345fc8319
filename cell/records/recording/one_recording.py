"""One recording as it is written: what cannot be written is counted, never raised."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from cell.records.recording import form
from cell.records.recording.reading import TornRecordingError
from cell.records.recording.writer import FullDiskError, RecordingWriter

#: What was put into the ring is in the file so soon, s, if the computer has time for it …
FLUSH_S = 0.02
#: … and on the disk itself.
SYNC_S = 0.25


class RecordingUnderWay:
    """One recording, from its first message to its last.

    part  file until it is complete; None = `recording.mcap.part` beside `path`
    """

    def __init__(self, path: Path, begun: Mapping[str, str], part: Path | None = None) -> None:
        self.path = path
        self._lost = self._all_lost = self._lost_messages = 0
        self._cause = ""
        self._first_lost: int | None = None
        self._last_s = 0.0
        self._flushed_s = self._synced_s = time.monotonic()
        self._part = self.path.with_name(form.PART) if part is None else part
        self._writer: RecordingWriter | None = None
        try:
            self._writer = RecordingWriter(self._part, begun)
        except OSError as error:
            self._refuse(error)

    def write(self, header: tuple[Any, ...], payload: bytes) -> None:
        """Write one message; what cannot be written is counted as lost."""
        if self._writer is None:
            self._lose(header)
            return
        kind, *rest = header
        try:
            match kind:
                case "frame":
                    index, t_s, height, width = rest
                    self._last_s = t_s
                    self._writer.frame(index, t_s, height, width, payload[: height * width])
                    if self._lost:
                        self._mark_gap()
                case "poses":
                    self._writer.poses(*rest)
                case "seen":
                    self._writer.seen(*rest)
                case "log":
                    self._writer.log(*rest)
                case "event":
                    self._writer.event(*rest)
        except FullDiskError as error:
            self._cause = self._cause or str(error)
            self._lose(header)
        except (OSError, RuntimeError) as error:
            self._refuse(error)
            self._lose(header)

    def keep_up(self, now: bool = False) -> None:
        """Bring what was written to the file, and to the disk, from time to time."""
        passed_s = time.monotonic()
        if self._writer is None or not (now or passed_s - self._flushed_s >= FLUSH_S):
            return
        self._flushed_s = passed_s
        try:
            self._writer.flush()
        except (OSError, RuntimeError) as error:
            self._refuse(error)
            return
        if passed_s - self._synced_s >= SYNC_S:
            self._synced_s = passed_s
            self._writer.sync()

    def end(self, keep: bool, complete: bool) -> dict[str, Any]:
        """Close the file, read it back and say what became of it."""
        report = {"path": str(self.path), "kept": keep, "complete": complete}
        report["lost_messages"] = self._lost_messages
        if self._writer is None:
            report |= {"error": self._cause, "lost_frames": self._all_lost}
            if not keep:
                self._part.unlink(missing_ok=True)
            return report
        try:
            if self._lost:
                with suppress(FullDiskError):
                    self._mark_gap()
            counts = dict(self._writer.counts)
            closed = {"complete": json.dumps(complete), "counts": json.dumps(counts)}
            with self._part.open("rb"):  # open until it has its name: nobody recovers it
                self._writer.close(closed)
                if keep:
                    _verify_apart(self._part, counts)
                    self._part.rename(self.path)
                else:
                    self._part.unlink()
            if keep:
                _sync_folder(self.path.parent)
                report["bytes"] = self.path.stat().st_size
            report |= {"frames": counts.get(form.IMAGE, 0), "poses": counts.get(form.MEASURED, 0)}
        except (OSError, RuntimeError, TornRecordingError) as error:
            self._cause = self._cause or str(error)
            report["error"] = str(error)
        return report | {"lost_frames": self._all_lost, "cause": self._cause}

    def _lose(self, header: tuple[Any, ...]) -> None:
        if header[0] == "frame":
            if self._first_lost is None:
                self._first_lost = header[1]
            self._lost += 1
            self._all_lost += 1
        else:
            self._lost_messages += 1

    def _mark_gap(self) -> None:
        assert self._writer is not None
        gap = {"first": self._first_lost, "frames": self._lost, "cause": self._cause}
        self._writer.event(form.GAP, self._last_s, gap)
        self._lost, self._first_lost = 0, None

    def _refuse(self, error: Exception) -> None:
        """Nothing more can be written; the file stays as it is."""
        self._cause = self._cause or f"the recording cannot be written: {error}"
        if self._writer is not None:
            with suppress(OSError):
                self._writer.abandon()
        self._writer = None


def _verify_apart(path: Path, counts: dict[str, int]) -> None:
    """Verify in a process of its own: the next cycle is recorded meanwhile.

    raises  TornRecordingError
    """
    command = [
        sys.executable,
        "-m",
        "cell.records.recording.reading",
        str(path),
        json.dumps(counts),
    ]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        if done.returncode < 0:  # as by a system without memory
            name = signal.Signals(-done.returncode).name
            raise TornRecordingError(f"{path} is not verified: {name} has ended whoever did it")
        raise TornRecordingError(done.stderr.strip().splitlines()[-1])


def _sync_folder(folder: Path) -> None:
    """Bring a new name in a folder to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
