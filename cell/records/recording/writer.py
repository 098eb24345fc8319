"""Writes a recording's file; used by the recorder's process alone.

A chunk of the file is complete on the disk with every frame and every flush, so that a killed
process loses only later messages.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove import Channel, Context, messages
from foxglove.channels import (
    ImageAnnotationsChannel,
    LogChannel,
    PoseInFrameChannel,
    RawImageChannel,
)
from foxglove.mcap import MCAPCompression, MCAPWriteOptions, MCAPWriter

from cell.cable.arrays import FloatArray
from cell.files.atomic import free_bytes
from cell.files.plain import plain
from cell.records.recording import form
from cell.records.recording.reading import TornRecordingError
from drivers.threads import GuardedThread, error_text

#: Frames end a chunk each; smaller messages share one until the next flush.
CHUNK_BYTES = 256 * 1024
#: Level 1 compresses frames with noise by a third at 450 MB/s, level 3 hardly more at 70 MB/s.
LEVEL = 1
#: Reserve on the disk for the cycle's own record and for other programs …
LEAST_FREE_BYTES = 64 * 2**20
#: … of which messages other than frames may use this share.
_SHARE_OF_MESSAGES = 0.5

_LEVELS = {
    "DEBUG": messages.LogLevel.Debug,
    "INFO": messages.LogLevel.Info,
    "WARNING": messages.LogLevel.Warning,
    "ERROR": messages.LogLevel.Error,
    "CRITICAL": messages.LogLevel.Fatal,
}


class FullDiskError(OSError):
    """There is no room on the disk.  Scenario: another program fills it during a cycle."""


class Sink:
    """Output file for the MCAP library; keeps the system's error if writing fails."""

    def __init__(self, path: Path) -> None:
        self.refused: OSError | None = None
        self._file = os.open(path, os.O_CREAT | os.O_RDWR | os.O_EXCL, 0o644)

    def write(self, data: bytes) -> int:
        """Write all of it."""
        try:
            remaining = memoryview(data)
            while remaining:
                remaining = remaining[os.write(self._file, remaining) :]
        except OSError as error:
            self.refused = error
            raise
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """As of a file."""
        return os.lseek(self._file, offset, whence)

    def flush(self) -> None:
        """Do nothing: writes are not buffered."""

    def sync(self) -> None:
        """Flush the file to the disk itself."""
        os.fdatasync(self._file)

    def close(self) -> None:
        """Close the file; later writes are refused."""
        os.close(self._file)
        self._file = -1


def open_mcap(sink: Sink, context: Context, level: int = LEVEL) -> MCAPWriter:
    """Open an MCAP writer for the channels of a context; `level`: zstd compression."""
    return foxglove.open_mcap(
        sink,  # type: ignore[arg-type]
        context=context,
        writer_options=MCAPWriteOptions(
            compression=MCAPCompression.Zstd,
            compression_level=level,
            compression_threads=0,
            chunk_size=CHUNK_BYTES,
        ),
    )


class RecordingWriter:
    """One recording's file.

    begun   metadata of the beginning; its `epoch_ns`, nanoseconds since 1970, is added to times on
            the cell's clock
    raises  OSError, from every method that writes
    """

    def __init__(self, path: Path, begun: Mapping[str, str]) -> None:
        self.path = path
        self.counts: Counter[str] = Counter()
        self._epoch_ns = int(begun[form.EPOCH])
        self._context = Context()
        self._sink = Sink(path)
        self._syncing: GuardedThread | None = None
        self._writer = open_mcap(self._sink, self._context)
        self._json = {
            topic: Channel(
                topic,
                schema=form.json_schema(topic),
                message_encoding="json",
                context=self._context,
            )
            for topic in form.JSON_TOPICS
        }
        self._images = RawImageChannel(form.IMAGE, context=self._context)
        self._detections = ImageAnnotationsChannel(form.SEEN, context=self._context)
        self._log = LogChannel(form.LOG, context=self._context)
        self._poses = {
            topic: PoseInFrameChannel(topic, context=self._context)
            for topic in (form.MEASURED, form.COMMANDED)
        }
        self._writer.write_metadata(form.BEGUN, {"format": form.FORMAT, **begun})

    def frame(self, index: int, t_s: float, height: int, width: int, data: bytes) -> None:
        """A frame of grey levels, one byte each.  Raises FullDiskError."""
        self._check_room(LEAST_FREE_BYTES + len(data))
        self.event(form.FRAME, t_s, {"index": index, "t_s": t_s})
        image = messages.RawImage(
            timestamp=self._stamp(t_s),
            frame_id="camera",
            width=width,
            height=height,
            encoding="mono8",
            step=width,
            data=data,
        )
        self._images.log(image, log_time=self._ns(t_s))
        self._count(form.IMAGE)

    def poses(self, topic: str, poses: FloatArray) -> None:
        """Poses (n, 4): time on the cell's clock, x, y, angle."""
        for t_s, x_m, y_m, angle_rad in poses.tolist():
            x, y, z, w = form.quaternion(angle_rad)
            pose = messages.Pose(
                position=messages.Vector3(x=x_m, y=y_m, z=0.0),
                orientation=messages.Quaternion(x=x, y=y, z=z, w=w),
            )
            message = messages.PoseInFrame(timestamp=self._stamp(t_s), frame_id="plane", pose=pose)
            self._poses[topic].log(message, log_time=self._ns(t_s))
            self._count(topic)

    def add_detections(self, t_s: Sequence[float], points_px: FloatArray) -> None:
        """The cable in the pictures: (n, points, 2) column and row, nan = not detected."""
        for at_s, points in zip(t_s, points_px, strict=True):
            stamp = self._stamp(at_s)
            line = messages.PointsAnnotation(
                timestamp=stamp,
                type=messages.PointsAnnotationType.LineStrip,
                points=[
                    messages.Point2(x=float(x), y=float(y)) for x, y in points if np.isfinite(x + y)
                ],
                outline_color=messages.Color(r=0.0, g=0.8, b=1.0, a=1.0),
                thickness=2.0,
            )
            self._detections.log(messages.ImageAnnotations(points=[line]), log_time=self._ns(at_s))
            self._count(form.SEEN)

    def log(self, t_s: float, level: str, name: str, text: str) -> None:
        """A line of the program's log."""
        message = messages.Log(
            timestamp=self._stamp(t_s),
            level=_LEVELS.get(level, messages.LogLevel.Unknown),
            message=text,
            name=name,
        )
        self._log.log(message, log_time=self._ns(t_s))
        self._count(form.LOG)

    def event(self, topic: str, t_s: float, data: Mapping[str, Any]) -> None:
        """A JSON message; numbers are written so that they are read back unchanged."""
        self._check_room(LEAST_FREE_BYTES * _SHARE_OF_MESSAGES)
        text = json.dumps(plain(data), ensure_ascii=False, allow_nan=False)
        self._json[topic].log(text.encode(), log_time=self._ns(t_s))
        self._count(topic)

    def flush(self) -> None:
        """End the chunk, so that all messages so far are in the file."""
        self._writer.flush()
        self._check()

    def sync(self) -> None:
        """Flush the file to the disk in a thread, concurrently with further writes."""
        if self._syncing is None or not self._syncing.is_alive():
            self._syncing = GuardedThread("sync", self._sink.sync, self._not_synced)
            self._syncing.start()

    def close(self, closed: Mapping[str, str]) -> None:
        """End the file with its index and the mark that it is complete."""
        try:
            self._writer.write_metadata(form.CLOSED, dict(closed))
            self._writer.close()
            self._join()
            self._check()
            self._sink.sync()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is, without an index: `cell recover` makes it readable."""
        self._join()
        self._sink.close()

    def _not_synced(self, error: BaseException) -> None:
        """Keep the error for the next write: the system reports it only once."""
        self._sink.refused = error if isinstance(error, OSError) else OSError(error_text(error))

    def _join(self) -> None:
        """Wait for the flush: the file must stay open until it has ended."""
        if self._syncing is not None:
            self._syncing.join()

    def _count(self, topic: str) -> None:
        self.counts[topic] += 1
        self._check()

    def _check(self) -> None:
        if self._sink.refused is not None:
            raise self._sink.refused

    def _check_room(self, needed_bytes: float) -> None:
        if free_bytes(self.path.parent) < needed_bytes:
            raise FullDiskError(
                f"less than {needed_bytes / 2**20:.0f} MiB are free on the disk of {self.path}"
            )

    def _ns(self, t_s: float) -> int:
        return self._epoch_ns + round(t_s * 1e9)

    def _stamp(self, t_s: float) -> messages.Timestamp:
        seconds, nanoseconds = divmod(self._ns(t_s), 10**9)
        return messages.Timestamp(sec=seconds, nsec=nanoseconds)


#: Time until messages in the ring are in the file, s, if the processor is free …
FLUSH_S = 0.02
#: … and on the disk itself.
SYNC_S = 0.25


class RecordingSession:
    """One recording, from its first message to its last.

    part    file until it is complete; None = `recording.mcap.part` next to `path`
    vision  pickled `VisionSetup`: frames of a complete recording are stored as bands; None = full
            frames are stored
    """

    def __init__(
        self,
        path: Path,
        begun: Mapping[str, str],
        part: Path | None = None,
        vision: bytes | None = None,
    ) -> None:
        self.path = path
        self._vision = vision
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
        """Write one message; a failed write is counted as lost."""
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
                    self._writer.add_detections(*rest)
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
        """Flush to the file, and to the disk, at intervals."""
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

    def end(self, keep: bool, complete: bool, full: bool = False) -> dict[str, Any]:
        """Close the file, read it back and report the result.

        full  whether full frames are stored too, in a separate file
        """
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
                    vision = self._vision if complete else None  # else somebody waits for it
                    report["not_reduced"] = self._verify(counts, vision, full)
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

    def _verify(self, counts: dict[str, int], vision: bytes | None, full: bool) -> str:
        """Read the file back, and give its final name to it or to its copy with bands.

        returns  why there is no band though one was requested, or ""
        """
        why, expected = "", json.dumps(counts)
        if vision is not None:
            band, frames = self.path.with_name(form.BAND), self.path.with_name(form.WHOLE)
            try:
                band.unlink(missing_ok=True)
                place = str(self._part), str(band)
                _run("cell.records.recording.band", *place, expected, stdin=vision)
            except (OSError, TornRecordingError) as error:
                why = str(error)
                with suppress(OSError):
                    band.unlink(missing_ok=True)
            else:
                band.rename(self.path)
                if full:
                    self._part.rename(frames)
                else:
                    self._part.unlink()
                return ""
        _run("cell.records.recording.reading", str(self._part), expected)
        self._part.rename(self.path)
        return why

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
        """Stop writing; the file is not changed any more."""
        self._cause = self._cause or f"the recording cannot be written: {error}"
        if self._writer is not None:
            with suppress(OSError):
                self._writer.abandon()
        self._writer = None


def _run(module: str, *arguments: str, stdin: bytes = b"") -> None:
    """Run a module in its own process, so that the next cycle is recorded in the meantime.

    stdin   its standard input
    raises  TornRecordingError
    """
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments], input=stdin, stderr=subprocess.PIPE
    )
    if done.returncode < 0:  # as by a system without memory
        name = signal.Signals(-done.returncode).name
        raise TornRecordingError(f"{arguments[0]} is not verified: {name} has ended whoever did it")
    if done.returncode:
        raise TornRecordingError(done.stderr.decode(errors="replace").strip().splitlines()[-1])


def _sync_folder(folder: Path) -> None:
    """Bring a new name in a folder to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
