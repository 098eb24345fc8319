"""Writes a recording's file; used by the recorder's process alone.

A chunk of the file is complete on the disk with every frame and every flush, so that a killed
process costs what came since.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
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
from cell.files.plain import plain
from cell.records.recording import form
from drivers.threads import GuardedThread, said

#: Frames end a chunk each; smaller messages share one until the next flush.
CHUNK_BYTES = 256 * 1024
#: Level 1 compresses frames with noise by a third at 450 MB/s, level 3 hardly more at 70 MB/s.
LEVEL = 1
#: Left free on the disk for the cycle's own record and for other programs …
LEAST_FREE_BYTES = 64 * 2**20
#: … of which messages that are not frames may use this share.
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
    """The file as the writing library wants it; keeps what the system has refused."""

    def __init__(self, path: Path) -> None:
        self.refused: OSError | None = None
        self._file = os.open(path, os.O_CREAT | os.O_RDWR | os.O_EXCL, 0o644)

    def write(self, data: bytes) -> int:
        """Write all of it."""
        try:
            left = memoryview(data)
            while left:
                left = left[os.write(self._file, left) :]
        except OSError as error:
            self.refused = error
            raise
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """As of a file."""
        return os.lseek(self._file, offset, whence)

    def flush(self) -> None:
        """Nothing is held back here."""

    def sync(self) -> None:
        """Bring what was written to the disk itself."""
        os.fdatasync(self._file)

    def close(self) -> None:
        """Close the file; what is written to it later is refused."""
        os.close(self._file)
        self._file = -1


def open_mcap(sink: Sink, context: Context) -> MCAPWriter:
    """Begin an MCAP file for the channels of a context."""
    return foxglove.open_mcap(
        sink,  # type: ignore[arg-type]
        context=context,
        writer_options=MCAPWriteOptions(
            compression=MCAPCompression.Zstd,
            compression_level=LEVEL,
            compression_threads=0,
            chunk_size=CHUNK_BYTES,
        ),
    )


class RecordingWriter:
    """One recording's file.

    begun   what is said at the beginning; `epoch_ns` of it is added to times on the cell's clock:
            nanoseconds since 1970
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
        self._seen = ImageAnnotationsChannel(form.SEEN, context=self._context)
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
        self._told(form.IMAGE)

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
            self._told(topic)

    def seen(self, t_s: Sequence[float], points_px: FloatArray) -> None:
        """The cable in the pictures: (n, points, 2) column and row, nan = not seen."""
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
            self._seen.log(messages.ImageAnnotations(points=[line]), log_time=self._ns(at_s))
            self._told(form.SEEN)

    def log(self, t_s: float, level: str, name: str, text: str) -> None:
        """A line of the program's log."""
        message = messages.Log(
            timestamp=self._stamp(t_s),
            level=_LEVELS.get(level, messages.LogLevel.Unknown),
            message=text,
            name=name,
        )
        self._log.log(message, log_time=self._ns(t_s))
        self._told(form.LOG)

    def event(self, topic: str, t_s: float, data: Mapping[str, Any]) -> None:
        """A JSON message; numbers are written so that they are read back unchanged."""
        self._check_room(LEAST_FREE_BYTES * _SHARE_OF_MESSAGES)
        text = json.dumps(plain(data), ensure_ascii=False, allow_nan=False)
        self._json[topic].log(text.encode(), log_time=self._ns(t_s))
        self._told(topic)

    def flush(self) -> None:
        """End the chunk: what was written so far is in the file."""
        self._writer.flush()
        self._check()

    def sync(self) -> None:
        """Have the system bring the file to the disk, beside what is written next."""
        if self._syncing is None or not self._syncing.is_alive():
            self._syncing = GuardedThread("sync", self._sink.sync, self._not_synced)
            self._syncing.start()

    def close(self, closed: Mapping[str, str]) -> None:
        """End the file with its index and the mark that nothing more comes."""
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
        """The system says only once that it could not: whoever writes next is told."""
        self._sink.refused = error if isinstance(error, OSError) else OSError(said(error))

    def _join(self) -> None:
        """The file must stay open until the system has brought it to the disk."""
        if self._syncing is not None:
            self._syncing.join()

    def _told(self, topic: str) -> None:
        self.counts[topic] += 1
        self._check()

    def _check(self) -> None:
        if self._sink.refused is not None:
            raise self._sink.refused

    def _check_room(self, needed_bytes: float) -> None:
        found = os.statvfs(self.path.parent)
        if found.f_bavail * found.f_frsize < needed_bytes:
            raise FullDiskError(
                f"less than {needed_bytes / 2**20:.0f} MiB are free on the disk of {self.path}"
            )

    def _ns(self, t_s: float) -> int:
        return self._epoch_ns + round(t_s * 1e9)

    def _stamp(self, t_s: float) -> messages.Timestamp:
        seconds, nanoseconds = divmod(self._ns(t_s), 10**9)
        return messages.Timestamp(sec=seconds, nsec=nanoseconds)
