"""The newest frame of a recording while it is written, read from its file alone.

The cell and its recorder do nothing for it: whoever looks reads what is on the disk already.
"""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk
from numpy.typing import NDArray

from cell.records.recording import form
from cell.records.recording.reading import UNREADABLE, image_of

_MAGIC_BYTES, _CHUNK = 8, 6
_HEAD = struct.Struct("<BQ")


class GrowingRecording:
    """A file that another process writes; what was read once is not read again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._at = _MAGIC_BYTES

    def newest(self) -> tuple[float, NDArray[np.uint8]] | None:
        """The newest frame, grey levels, and its age when the file was last written, s.

        The age is on the cell's clock.  None = no newer frame came.
        raises  OSError: the file has gone
        """
        new: list[int] = []
        with self.path.open("rb") as file:
            size = file.seek(0, 2)
            while self._at + _HEAD.size <= size:
                file.seek(self._at)
                kind, length = _HEAD.unpack(file.read(_HEAD.size))
                if self._at + _HEAD.size + length > size:
                    break
                if kind == _CHUNK:
                    new.append(self._at)
                self._at += _HEAD.size + length
            last_ns = 0
            for place in reversed(new):
                file.seek(place + _HEAD.size)
                try:
                    chunk = Chunk.read(ReadDataStream(file))
                    records = breakup_chunk(chunk)
                except UNREADABLE:
                    continue
                last_ns = max(last_ns, chunk.message_end_time)
                for message in reversed(records):
                    if isinstance(message, Message) and (found := _frame(message)) is not None:
                        return (last_ns - message.log_time) * 1e-9, found
        return None


def recording_under_way(runs: Path) -> Path | None:
    """The file of the newest cycle's recording while it is written; None = there is none."""
    newest = _newest_cycle(runs)
    path = None if newest is None else newest / form.PART
    return path if path is not None and path.exists() else None


def is_unrecorded(runs: Path) -> bool:
    """Whether the newest cycle has no result yet, and is not recorded either."""
    newest = _newest_cycle(runs)
    names = ("result.json", form.PART, form.FILE)
    return newest is not None and not any((newest / name).exists() for name in names)


def _newest_cycle(runs: Path) -> Path | None:
    """Its folder; None = there is none yet."""
    try:
        return max((p for p in runs.iterdir() if p.name[:1].isdigit()), default=None)
    except OSError:
        return None


def small_jpeg(image: NDArray[np.uint8], width_px: int) -> bytes:
    """A frame as JPEG of at most this width; every second or third pixel, which is quick."""
    step = max(1, -(-image.shape[1] // width_px))
    return bytes(cv2.imencode(".jpg", image[::step, ::step], [cv2.IMWRITE_JPEG_QUALITY, 80])[1])


def _frame(message: Message) -> NDArray[np.uint8] | None:
    try:
        return image_of(message.data)
    except (DecodeError, ValueError):  # of another topic
        return None
