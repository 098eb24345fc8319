"""Reads recordings: frames, poses, JSON messages; reports damage of a file."""

from __future__ import annotations

import errno
import json
import struct
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import CRCValidationError, breakup_chunk
from mcap.summary import Summary
from numpy.typing import NDArray
from zstandard import ZstdError

from cell.computer.memory import reuse_freed_memory
from cell.files.input_error import InputError
from cell.files.text_file import known_json
from cell.files.words import counted
from cell.records.recording import form
from drivers.interfaces import Frame, Trajectory

#: First bytes of an MCAP file.
MAGIC = b"\x89MCAP0\r\n"
#: Head of a record: type and length.
_HEAD = struct.Struct("<BQ")
#: Exceptions of readers for a torn file or another format.
UNREADABLE = (
    McapError, CRCValidationError, ZstdError, ValueError, EOFError, MemoryError, LookupError,
    OverflowError, struct.error,
)  # fmt: skip


class TornRecordingError(Exception):
    """A recording lacks its end, or is damaged.  Scenario: power was cut during a cycle."""


def verify(path: Path, counts: Mapping[str, int] | None = None) -> dict[str, int]:
    """Read a recording from its beginning to its end; number of messages by topic.

    counts  expected number of messages by topic; None = as its metadata state
    raises  TornRecordingError: it lacks something, or a checksum is wrong; OSError
    """
    try:
        with path.open("rb") as file:
            summary = make_reader(file, validate_crcs=True).get_summary()
            if summary is None or summary.statistics is None:
                raise TornRecordingError(f"{path} has no index")
            stated = _counts(summary)
            read = Counter(topic for topic, _ in messages_in(file, summary))
    except UNREADABLE as error:
        raise TornRecordingError(f"{path} {_why(error)}") from error
    for expected in (stated, counts or stated):
        missing = {t: (n, read[t]) for t, n in expected.items() if read[t] != n}
        if missing:
            topic, (wanted, there) = next(iter(missing.items()))
            raise TornRecordingError(f"{path} has {there} of {wanted} messages of {topic}")
    return dict(read)


@dataclass(frozen=True)
class Recording:
    """A recording that was opened by `read_recording`.

    Reading a damaged part raises InputError.

    started  metadata from its beginning: software version, host, cycle …
    closed   metadata from its end
    """

    path: Path
    started: Mapping[str, str]
    closed: Mapping[str, str]
    _counts: Mapping[str, int] = field(repr=False)

    @property
    def complete(self) -> bool:
        """Whether the cycle was recorded to its end."""
        return json.loads(self.closed.get("complete", "false")) is True

    def check(self) -> None:
        """Read the complete file.  Raises InputError: it is damaged."""
        try:
            verify(self.path)
        except TornRecordingError as error:
            raise damaged(self.path, error) from error

    def losses(self) -> tuple[str, ...]:
        """Measurements that are missing: dropped while recording, or not recovered."""
        gaps = [
            f"{counted(gap['frames'], 'frame is', 'frames are')} missing: {gap['cause']}"
            for gap in self.json(form.GAP)
        ]
        damaged = int(self.closed.get(form.DAMAGED_BYTES, "0"))
        lost = [f"{damaged} damaged bytes could not be recovered"] if damaged else []
        return (*lost, *gaps)

    def count(self, topic: str) -> int:
        """Number of messages of a topic."""
        return self._counts.get(topic, 0)

    def json(self, topic: str) -> Iterator[dict[str, Any]]:
        """Messages of a JSON topic, in the order in which they were written."""
        for _, data in self._messages(topic):
            yield json.loads(data)

    def last(self, topic: str) -> dict[str, Any] | None:
        """Last message of a JSON topic; None = there is none."""
        message = None
        for message in self.json(topic):  # noqa: B007
            pass
        return message

    def frames(self) -> Iterator[Frame]:
        """Frames in the order in which they were read, with their exact times."""
        for frame, _ in self.detections():
            yield frame

    def detections(self) -> Iterator[tuple[Frame, np.ndarray | None]]:
        """The same, with the detected cable: (n, 2) column and row; None = not detected."""
        points_px = {}
        for log_time, data in self._messages(form.SEEN):
            points = [p for line in ImageAnnotations.FromString(data).points for p in line.points]
            points_px[log_time] = np.array([(p.x, p.y) for p in points]).reshape(-1, 2)
        exact = {}
        for log_time, data in self._messages(form.FRAME):
            frame = json.loads(data)
            exact[log_time] = (frame["index"], frame["t_s"], frame.get("blank"))
        shown = None
        for log_time, data in self._messages(form.IMAGE):
            if log_time in exact:
                index, t_s, blank = exact[log_time]
                shown = shown_image(shown, image_of(data), blank)
                yield Frame(index, t_s, shown), points_px.get(log_time)

    def trajectories(self, topic: str) -> Iterator[tuple[dict[str, Any], Trajectory]]:
        """Messages of `/arm/path` or `/arm/answer` with their poses."""
        for message in self.json(topic):
            columns = (np.array(message[k], float) for k in ("t_s", "x_m", "y_m", "angle_rad"))
            yield message, Trajectory(*columns)

    def _messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        try:
            with self.path.open("rb") as file:
                summary = make_reader(file, validate_crcs=True).get_summary()
                assert summary is not None, "`read_recording` has read it"
                for _, message in messages_in(file, summary, topic):
                    yield message.log_time, message.data
        except UNREADABLE as error:
            raise damaged(self.path, error) from error


def messages_in(
    file: BinaryIO, summary: Summary, topic: str | None = None
) -> Iterator[tuple[str, Message]]:
    """Messages of a recording and their topics, in the file's order; one chunk is in memory.

    The library's reader holds all chunks if it does not sort messages by time.
    topic   the only one to read; None = all
    raises  one of `UNREADABLE`: the file is damaged; OSError
    """
    topics = {n: c.topic for n, c in summary.channels.items() if topic in (None, c.topic)}
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        if topics.keys().isdisjoint(index.message_index_offsets):
            continue
        file.seek(index.chunk_start_offset + _HEAD.size)
        for record in breakup_chunk(Chunk.read(ReadDataStream(file)), validate_crc=True):
            if isinstance(record, Message) and record.channel_id in topics:
                yield topics[record.channel_id], record


def damaged(path: Path, error: Exception) -> InputError:
    """Error message about damage within a recording."""
    torn = isinstance(error, TornRecordingError)
    why = str(error).removeprefix(f"{path} ") if torn else _why(error)
    return InputError.at(path, f"{why}; `cell recover {path}` copies what is whole")


def _why(error: Exception) -> str:
    wrong_sum = isinstance(error, CRCValidationError)
    return f"is damaged: {'a checksum is wrong' if wrong_sum else repr(error)}"


def lacks_end(path: Path) -> bool:
    """Whether a recording has no readable index at its end.  Raises OSError."""
    try:
        with path.open("rb") as file:
            summary = make_reader(file, validate_crcs=True).get_summary()
    except UNREADABLE:
        return True
    return summary is None or summary.statistics is None


def check_begins(path: Path) -> None:
    """Raise InputError if a file does not begin as MCAP; OSError if it cannot be read."""
    with path.open("rb") as file:
        begins = file.read(len(MAGIC))
    if begins != MAGIC:
        size = path.stat().st_size
        message = f"is no MCAP file: it begins with {begins!r}, {size} bytes in all"
        raise InputError.at(path, message)


def read_recording(path: Path) -> Recording:
    """Open a recording, or the one in a cycle's folder.

    raises  InputError: there is none, it is torn, it is not one of this program, or it is in the
            folder of another cycle
    """
    if path.is_dir():
        path = recording_in(path)
    try:
        check_begins(path)
        with path.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError.at(path, "is missing; give a recording or a cycle's folder") from error
    except (OSError, *UNREADABLE) as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # too short for an index
            raise InputError.at(path, f"cannot be read: {error.strerror}") from error
        message = f"is torn; `cell recover {path}` makes what is there readable"
        raise InputError.at(path, message) from error
    begun = metadata.get(form.BEGUN)
    if begun is None or summary is None or summary.statistics is None:
        raise InputError.at(path, "is an MCAP file, but no recording of `cell run`")
    if begun.get("format") != form.FORMAT:
        name = begun.get("format")
        raise InputError.at(path, f"format is {name!r}, not {form.FORMAT!r}; use that version")
    _check_folder(path, begun)
    return Recording(path, begun, metadata.get(form.CLOSED, {}), _counts(summary))


def _counts(summary: Summary) -> dict[str, int]:
    """Number of messages by topic, as the index states it; empty without statistics."""
    counts = {} if summary.statistics is None else summary.statistics.channel_message_counts
    return {summary.channels[number].topic: n for number, n in counts.items()}


def _check_folder(path: Path, begun: Mapping[str, str]) -> None:
    """Raise InputError if a recording is in the folder of another cycle."""
    state = known_json(path.with_name("state.json")) if path.name == form.FILE else {}
    own, folders = ((str(of.get("cycle", "")), _moment(of.get("started"))) for of in (begun, state))
    if any(a and b and a != b for a, b in zip(own, folders, strict=True)):
        recorded, expected = (f"cycle {n or '?'}, begun {at or '?'}" for n, at in (own, folders))
        message = f"is of {recorded}, its folder of {expected}; put it into the folder of its cycle"
        raise InputError.at(path, message)


def _moment(text: object) -> datetime | None:
    """A time in UTC; None = it is none."""
    try:
        return datetime.fromisoformat(str(text)).astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def recording_in(folder: Path) -> Path:
    """The recording in a cycle's folder.  Raises InputError: there is none, or it is torn."""
    if (folder / form.FILE).exists():
        return folder / form.FILE
    if (folder / form.PART).exists():
        message = f"was not finished; `cell recover {folder}` makes what is there readable"
        raise InputError.at(folder / form.PART, message)
    if (folder / form.STORED).exists():
        message = f"says that the recording is in a store; `cell fetch {folder}` brings it back"
        raise InputError.at(folder / form.STORED, message)
    raise InputError.at(
        folder / form.FILE,
        "is missing: this cycle was not recorded, or its recording was removed to make room",
    )


def image_of(data: bytes) -> np.ndarray:
    """(H, W) grey levels of a message of `/camera/image`.  Raises ValueError: it is not one."""
    message = RawImage.FromString(data)
    if message.encoding != "mono8" or message.step != message.width:
        raise ValueError(f"a frame is {message.encoding} with step {message.step}, not mono8")
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width)


def shown_image(
    before: NDArray[np.uint8] | None, image: NDArray[np.uint8], blank: int | None
) -> NDArray[np.uint8]:
    """(H, W) grey levels of a frame that is stored as a band.

    before  the frame before it; None = there is none
    image   as stored
    blank   grey level of pixels that are as before; None = the image is complete
    """
    if blank is None or before is None or before.shape != image.shape:
        return image
    shown = before.copy()
    np.copyto(shown, image, where=image != blank)
    return shown


class GrowingRecording:
    """Reads a file while another process appends to it; each part is read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._at = len(MAGIC)

    def newest(self) -> tuple[float, NDArray[np.uint8]] | None:
        """The newest frame, grey levels, and its age when the file was last written, s.

        The age is on the cell's clock.  None = no newer frame.
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
                if kind == Opcode.CHUNK:
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
                    if isinstance(message, Message) and (image := _frame(message)) is not None:
                        return (last_ns - message.log_time) * 1e-9, image
        return None


def recording_under_way(runs: Path) -> Path | None:
    """The file of the newest cycle's recording while it is written; None = there is none."""
    newest = _newest_cycle(runs)
    path = None if newest is None else newest / form.PART
    return path if path is not None and path.exists() else None


def is_unrecorded(runs: Path) -> bool:
    """Whether the newest cycle is unfinished and not being recorded."""
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


if __name__ == "__main__":  # as the recorder's process verifies a file
    reuse_freed_memory()
    try:
        verify(Path(sys.argv[1]), json.loads(sys.argv[2]))
    except (TornRecordingError, OSError) as error:
        sys.exit(str(error))
