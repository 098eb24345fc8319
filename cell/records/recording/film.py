"""Reads single frames of a recording by its index, without reading the rest of the file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from mcap.data_stream import ReadDataStream
from mcap.reader import McapReader, make_reader
from mcap.records import MessageIndex
from numpy.typing import NDArray

from cell.files.atomic import write_atomic
from cell.files.input_error import InputError
from cell.files.text_file import known_json
from cell.files.yaml_document import read_yaml
from cell.records.recording import form
from cell.records.recording.reading import UNREADABLE, damaged, image_of, shown_image
from cell.records.recording.retention import KEPT

#: Before a record: what it is, and its length.
_HEAD_BYTES = 9
#: The cable as it was seen is drawn in this colour, blue first.
_SEEN = (255, 160, 0)
#: So is the destination.
_DESTINATION = (38, 38, 179)


@dataclass(frozen=True)
class RecordedFilm:
    """Index of the frames of a recording, in the order of their times.

    stamps_ns  when each was taken, nanoseconds since 1970
    destination_px  (4, 2) corners of the destination; none where the recording does not say them
    """

    path: Path
    stamps_ns: tuple[int, ...]
    destination_px: NDArray[np.float64] = field(repr=False)

    @property
    def times_s(self) -> tuple[float, ...]:
        """Since the first frame."""
        return tuple((s - self.stamps_ns[0]) * 1e-9 for s in self.stamps_ns)


def read_film(path: Path) -> RecordedFilm:
    """Read the index of a recording's frames.

    raises  InputError: it cannot be read
    """
    stamps: list[int] = []
    with _read_errors(path), path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        if summary is None:
            raise ValueError("it has no index")
        begun = [json.loads(message.data) for _, _, message in reader.iter_messages([form.CYCLE])]
        images = {c.id for c in summary.channels.values() if c.topic == form.IMAGE}
        for chunk in summary.chunk_indexes:
            for channel in images & chunk.message_index_offsets.keys():
                file.seek(chunk.message_index_offsets[channel] + _HEAD_BYTES)
                stamps += [stamp for stamp, _ in MessageIndex.read(ReadDataStream(file)).records]
    corners_px = corners_of(begun[0] if begun else None)
    return RecordedFilm(path, tuple(sorted(stamps)), corners_px)


def corners_of(begun: Mapping[str, Any] | None) -> NDArray[np.float64]:
    """(4, 2) corners of the destination, px, in a cycle's first message; (0, 2) = not said."""
    return np.array((begun or {}).get("destination_px", ()), float).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class FilmFrame:
    """A frame as it is shown.

    image      (H, W) grey levels
    points_px  (n, 2) column and row of the cable as it was seen; none if it was not
    destination_px  (4, 2) its corners; none if not known
    """

    number: int
    image: NDArray[np.uint8] = field(repr=False)
    points_px: NDArray[np.float64] = field(repr=False)
    destination_px: NDArray[np.float64] = field(repr=False)

    def jpeg(self, width_px: int) -> bytes:
        """The frame with the destination and the cable as it was seen, as JPEG of at most this
        width.
        """
        picture = drawn(self.image, self.points_px, self.destination_px)
        scale = min(1.0, width_px / picture.shape[1])
        if scale < 1.0:
            size = (round(scale * picture.shape[1]), round(scale * picture.shape[0]))
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])[1])


def read_frame(film: RecordedFilm, number: int, near: FilmFrame | None = None) -> FilmFrame:
    """A frame of a recording.

    near    another frame of it, from which this one is found sooner if it is a little later
    raises  IndexError: there is no such frame; InputError: the recording cannot be read
    """
    if not 0 <= number < len(film.stamps_ns):
        raise IndexError(number)
    with _read_errors(film.path), film.path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        kept, blank, seen = _kept(reader, film.stamps_ns[number], form.SEEN)
        later, at = [(kept, blank)], number
        while blank is not None and at > 0:  # elsewhere it shows what was shown before
            at -= 1
            if near is not None and near.number == at:
                later.append((near.image, None))
                break
            kept, blank, _ = _kept(reader, film.stamps_ns[at])
            later.append((kept, blank))
        image: NDArray[np.uint8] | None = None
        for kept, blank in reversed(later):
            image = shown_image(image, kept, blank)
    assert image is not None
    return FilmFrame(number, image, np.array(seen).reshape(-1, 2), film.destination_px)


def _kept(
    reader: McapReader, stamp_ns: int, *also: str
) -> tuple[NDArray[np.uint8], int | None, Sequence[tuple[float, float]]]:
    """A frame as it was kept, its blank grey level, and the cable as it was seen.

    also    topics of what else is wanted
    raises  ValueError: it is not in the file
    """
    image, blank = None, None
    seen: list[tuple[float, float]] = []
    topics = form.IMAGE, form.FRAME, *also
    for _, channel, message in reader.iter_messages(
        topics, starting_at=stamp_ns, ending_at=stamp_ns
    ):
        if channel.topic == form.IMAGE:
            image = image_of(message.data)
        elif channel.topic == form.FRAME:
            blank = json.loads(message.data).get("blank")
        else:
            lines = ImageAnnotations.FromString(message.data).points
            seen = [(p.x, p.y) for line in lines for p in line.points]
    if image is None:
        raise ValueError(f"it has no frame of {stamp_ns} ns")
    return image, blank, seen


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """What the system or the file refuses, in words."""
    try:
        yield
    except OSError as error:
        raise InputError.at(path, f"cannot be read: {error.strerror}") from error
    except UNREADABLE as error:
        raise damaged(path, error) from error


def drawn(
    image: NDArray[np.uint8],
    points_px: NDArray[np.float64] | None,
    destination_px: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """(H, W, 3) picture, blue first: a frame (H, W) with destination and detected cable.

    points_px       (n, 2) column and row of the cable; None = it was not seen
    destination_px  (4, 2) corners; (0, 2) = not known
    """
    picture = np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_GRAY2BGR), np.uint8)
    if len(destination_px):
        outline = np.round(destination_px).astype(np.int32)[:, None]
        cv2.polylines(picture, [outline], True, _DESTINATION, 3, cv2.LINE_AA)
    if points_px is not None and len(points_px):
        line = np.round(points_px).astype(np.int32)[:, None]
        cv2.polylines(picture, [line], False, _SEEN, 4, cv2.LINE_AA)
        for u, v in line[:, 0].tolist():
            cv2.circle(picture, (u, v), 6, _SEEN, 2, cv2.LINE_AA)
    return picture


def why_no_film(folder: Path) -> str:
    """Why a cycle's folder has no recording that can be shown; "" = it has one."""
    if (folder / form.FILE).exists():
        return ""
    if (folder / form.PART).exists():
        return "the recording is being written, or its recorder was killed: cell recover"
    if (folder / form.STORED).exists():
        return f"the recording is in the store; bring it back: cell fetch {folder}"
    if (folder / form.REMOVED).exists():
        said = known_json(folder / form.REMOVED)
        return f"the recording was removed on {said.get('at', '?')}: {said.get('why', '?')}"
    if _recording_of(folder) is None:
        return "nothing was recorded: the settings said `recording: null`"
    return (
        "the recording is not written yet, or was not kept: see `keep` and the limits in the "
        "section `recording`"
    )


def keep_recording(folder: Path, kept: bool) -> None:
    """Mark a cycle's recording as kept for good, or no longer.  Raises OSError."""
    if kept:
        write_atomic(folder / KEPT, "")
    else:
        (folder / KEPT).unlink(missing_ok=True)


def is_protected(folder: Path) -> bool:
    """Whether a cycle's recording is kept for good."""
    return (folder / KEPT).exists()


def _recording_of(folder: Path) -> Any:
    """Section `recording` of the cycle's settings; "" = it is not known."""
    try:
        return read_yaml(folder / "settings.yaml").data.get("recording", "")
    except (InputError, AttributeError):
        return ""
