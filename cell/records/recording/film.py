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

#: Head of a record: type and length.
_HEAD_BYTES = 9
#: Colour of the detected cable, blue first.
_SEEN = (255, 160, 0)
#: Colour of the destination.
_DESTINATION = (38, 38, 179)


@dataclass(frozen=True)
class RecordedFilm:
    """Index of the frames of a recording, in the order of their times.

    stamps_ns  timestamp of each, nanoseconds since 1970
    destination_px  (4, 2) corners of the destination; (0, 2) if the recording has none
    """

    path: Path
    stamps_ns: tuple[int, ...]
    destination_px: NDArray[np.float64] = field(repr=False)

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times since the first frame."""
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
    """(4, 2) corners of the destination, px, in a cycle's first message; (0, 2) = unknown."""
    return np.array((begun or {}).get("destination_px", ()), float).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class FilmFrame:
    """A frame with its overlay.

    image      (H, W) grey levels
    points_px  (n, 2) column and row of the detected cable; (0, 2) if it was not detected
    destination_px  (4, 2) its corners; none if not known
    """

    number: int
    image: NDArray[np.uint8] = field(repr=False)
    points_px: NDArray[np.float64] = field(repr=False)
    destination_px: NDArray[np.float64] = field(repr=False)

    def jpeg(self, width_px: int) -> bytes:
        """The frame with the destination and the detected cable, as JPEG of at most this width."""
        picture = drawn(self.image, self.points_px, self.destination_px)
        scale = min(1.0, width_px / picture.shape[1])
        if scale < 1.0:
            size = (round(scale * picture.shape[1]), round(scale * picture.shape[0]))
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])[1])


def read_frame(film: RecordedFilm, number: int, near: FilmFrame | None = None) -> FilmFrame:
    """A frame of a recording.

    near    a frame of it, from which a slightly later one is computed faster
    raises  IndexError: there is no such frame; InputError: the recording cannot be read
    """
    if not 0 <= number < len(film.stamps_ns):
        raise IndexError(number)
    with _read_errors(film.path), film.path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        stored, blank, points = _stored_frame(reader, film.stamps_ns[number], form.SEEN)
        later, at = [(stored, blank)], number
        while blank is not None and at > 0:  # outside the band it shows the earlier picture
            at -= 1
            if near is not None and near.number == at:
                later.append((near.image, None))
                break
            stored, blank, _ = _stored_frame(reader, film.stamps_ns[at])
            later.append((stored, blank))
        image: NDArray[np.uint8] | None = None
        for stored, blank in reversed(later):
            image = shown_image(image, stored, blank)
    assert image is not None
    return FilmFrame(number, image, np.array(points).reshape(-1, 2), film.destination_px)


def _stored_frame(
    reader: McapReader, stamp_ns: int, *also: str
) -> tuple[NDArray[np.uint8], int | None, Sequence[tuple[float, float]]]:
    """A frame as it is stored, its blank grey level, and the detected cable.

    also    further topics to read
    raises  ValueError: it is not in the file
    """
    image, blank = None, None
    points: list[tuple[float, float]] = []
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
            points = [(p.x, p.y) for line in lines for p in line.points]
    if image is None:
        raise ValueError(f"it has no frame of {stamp_ns} ns")
    return image, blank, points


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    """Turn errors of the system or the file into InputError."""
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

    points_px       (n, 2) column and row of the cable; None = it was not detected
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
        removal = known_json(folder / form.REMOVED)
        return f"the recording was removed on {removal.get('at', '?')}: {removal.get('why', '?')}"
    if _recording_of(folder) is None:
        return "nothing was recorded: the settings said `recording: null`"
    return (
        "the recording is not written yet, or was not kept: see `keep` and the limits in the "
        "section `recording`"
    )


def keep_recording(folder: Path, protected: bool) -> None:
    """Set or clear the mark that protects a cycle's recording.  Raises OSError."""
    if protected:
        write_atomic(folder / KEPT, "")
    else:
        (folder / KEPT).unlink(missing_ok=True)


def is_protected(folder: Path) -> bool:
    """Whether a cycle's recording is marked as protected."""
    return (folder / KEPT).exists()


def _recording_of(folder: Path) -> Any:
    """Section `recording` of the cycle's settings; "" = it is not known."""
    try:
        return read_yaml(folder / "settings.yaml").data.get("recording", "")
    except (InputError, AttributeError):
        return ""
