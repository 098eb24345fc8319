"""Reduces recorded frames to the pixels that vision reads, to save room on the disk.

The band of a frame is the jaw's marks, the cable, and all pixels that have changed.
Outside it a frame is blank, and a reader shows the earlier picture there.  Full frames are the
first and the last of a film, every 150th, and each for which the band would change the result of
vision: a replay stays the same to the last bit.

    python -m cell.records.recording.band SOURCE TARGET COUNTS < pickled `VisionSetup`
"""

from __future__ import annotations

import gc
import json
import pickle
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.cable.arrays import FloatArray
from cell.computer.memory import reuse_freed_memory
from cell.records.recording import form
from cell.records.recording.copying import RecordingCopy
from cell.records.recording.reading import TornRecordingError, image_of, verify
from cell.vision.detect import VisionOptions, detect
from cell.vision.sighting import Sighting

#: Side of the squares of a band, px.
TILE_PX = 4
#: Interval of full frames in a film.
WHOLE_EVERY = 150
#: Change of a square's mean that counts: at least so many grey levels …
CHANGED_LEVELS = 4.0
#: … and so many standard deviations of the camera's noise.
CHANGED_STDS = 6.0
#: Half of the band's width about the cable: the reach of its profiles, px …
_CABLE_PX = 9.0
#: … or so many widths of its profile; and beyond its tip, px.
_CABLE_WIDTHS, _TIP_PX = 6.0, 18.0
#: Half of the regions about the jaw's marks, in their radii.
_MARK_RADII = 1.7
_WITH_NEIGHBOURS = np.ones((3, 3), np.uint8)
#: Level of zstd: pictures that are blank but for a band compress in no time.
_LEVEL = 3

Image = NDArray[np.uint8]
Tiles = NDArray[np.bool_]


@dataclass(frozen=True)
class VisionSetup:
    """What vision needs to process a cell's frames: map to the plane, and options."""

    view: PlaneView
    options: VisionOptions


class FilmBand:
    """Selects for each frame of a cycle's films, in order, the pixels to be stored."""

    def __init__(self, setup: VisionSetup) -> None:
        self._setup = setup
        self._shown: Image | None = None
        self._means: FloatArray | None = None
        self._before: Sighting | None = None
        self._least_change = np.inf

    def keep(self, index: int, t_s: float, image: Image, *, last: bool) -> tuple[Image, int | None]:
        """Stored part of a frame, (H, W), and its blank grey level; None = the full frame.

        index  of the frame in its film
        last   whether it is the last one of its film
        """
        before = None if index == 0 else self._before
        sighting = detect(image, t_s, self._setup.view, self._setup.options, before)
        means = tile_means(image)
        if index == 1 and self._means is not None:
            self._least_change = _least_change(means - self._means)
        band = None
        full = last or index % WHOLE_EVERY == 0
        if not full and self._shown is not None and self._shown.shape == image.shape:
            band = self._band(image, means, sighting)
        if band is None:
            self._shown, self._means = image, means
        self._before = sighting
        return (image, None) if band is None else band

    def _band(
        self, image: Image, means: FloatArray, sighting: Sighting
    ) -> tuple[Image, int] | None:
        """The same for a frame that may be reduced; None = it must be stored in full."""
        assert self._shown is not None and self._means is not None
        changed = (np.abs(means - self._means) > self._least_change).astype(np.uint8)
        tiles = cv2.dilate(changed, _WITH_NEIGHBOURS).astype(bool)  # an edge may touch the next one
        tiles |= read_tiles(sighting, self._setup, image.shape)
        within, mask = _pixels(tiles, image.shape)
        levels = np.bincount(image[within][mask], minlength=256)
        if levels.all():
            return None
        blank = int(np.argmin(levels > 0))
        stored: Image = np.full_like(image, blank)
        np.copyto(stored[within], image[within], where=mask)
        shown = self._shown.copy()
        np.copyto(shown[within], image[within], where=mask)
        view, options = self._setup.view, self._setup.options
        if not _same(detect(shown, sighting.t_s, view, options, self._before), sighting):
            return None
        self._shown, self._means = shown, np.where(tiles, means, self._means)
        return stored, blank


def tile_means(image: Image) -> FloatArray:
    """(⌈H/4⌉, ⌈W/4⌉) mean grey level of each tile of 4 × 4 pixels."""
    down, along = (-size % TILE_PX for size in image.shape)
    if down or along:
        image = np.pad(image, ((0, down), (0, along)), mode="edge")
    size = image.shape[1] // TILE_PX, image.shape[0] // TILE_PX
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), float)


def read_tiles(sighting: Sighting, setup: VisionSetup, shape: tuple[int, ...]) -> Tiles:
    """(⌈H/4⌉, ⌈W/4⌉) mask of the tiles that vision reads, around the detected jaw and cable."""
    tiles = np.zeros([-(-size // TILE_PX) for size in shape], np.uint8)
    if np.isfinite(sighting.nodes_m).all():
        half_px = max(_CABLE_PX, _CABLE_WIDTHS * setup.options.line_width_px)
        line_px = setup.view.to_pixels(sighting.nodes_m)
        ahead = line_px[0] - line_px[1]
        tip = line_px[0] + _TIP_PX * ahead / np.linalg.norm(ahead)
        line = np.vstack([tip, line_px]) / TILE_PX - 0.5
        bits = 4  # of a fraction
        points = np.round(line * 2**bits).astype(np.int32)[:, None]
        wide = int(np.ceil(2.0 * half_px / TILE_PX)) + 1
        cv2.polylines(tiles, [points], False, 1, wide, cv2.LINE_8, bits)
    if np.isfinite([*sighting.grip_m, sighting.clamp_angle_rad]).all():
        marks = setup.options.marks
        c, s = np.cos(sighting.clamp_angle_rad), np.sin(sighting.clamp_angle_rad)
        centres_m = np.array(marks.centres_m) @ np.array([[c, s], [-s, c]]) + sighting.grip_m
        centres_px = setup.view.to_pixels(centres_m)
        rim_px = setup.view.to_pixels(centres_m + np.array([marks.radius_m, 0.0]))
        half_px = _MARK_RADII * np.linalg.norm(rim_px - centres_px, axis=1)[:, None]
        first = np.floor((centres_px - half_px) / TILE_PX).astype(int).clip(0)
        end = np.floor((centres_px + half_px) / TILE_PX).astype(int).clip(-1) + 1
        for (left, top), (right, bottom) in zip(first, end, strict=True):
            tiles[top:bottom, left:right] = 1
    return tiles.astype(bool)


def _least_change(difference: FloatArray) -> float:
    """Least change of a square's mean that exceeds the camera's noise, grey levels."""
    std = 1.4826 * np.median(np.abs(difference - np.median(difference)))
    return float(max(CHANGED_LEVELS, CHANGED_STDS * std))


def _pixels(tiles: Tiles, shape: tuple[int, ...]) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
    """Bounding box of the squares in a picture (H, W), and the mask of their pixels in it."""
    spans = []
    for axis in (1, 0):
        used = np.flatnonzero(tiles.any(axis=axis))
        spans.append(slice(used[0], used[-1] + 1) if len(used) else slice(0, 0))
    part = tiles[spans[0], spans[1]]
    mask = np.repeat(np.repeat(part, TILE_PX, axis=0), TILE_PX, axis=1)
    rows, columns = (slice(s.start * TILE_PX, s.stop * TILE_PX) for s in spans)
    rows, columns = slice(*rows.indices(shape[0])), slice(*columns.indices(shape[1]))
    return (rows, columns), mask[: rows.stop - rows.start, : columns.stop - columns.start]


def _same(a: Sighting, b: Sighting) -> bool:
    """Whether two sightings are the same to the last bit."""
    return pickle.dumps(_values(a)) == pickle.dumps(_values(b))


def _values(s: Sighting) -> tuple[Any, ...]:
    numbers = np.array([s.t_s, s.clamp_angle_rad, s.quality, s.length_m])
    return s.nodes_m.tobytes(), s.grip_m.tobytes(), numbers.tobytes(), s.unseen


class _BandCopy(RecordingCopy):
    """Copies a recording with bands in place of its frames.

    A frame is held back until the next one shows whether it is the last of its film.
    """

    def __init__(self, path: Path, setup: VisionSetup) -> None:
        super().__init__(path, _LEVEL)
        self._band = FilmBand(setup)
        self._waiting: tuple[dict[str, Any], int] | None = None
        self._image: bytes | None = None

    def log(self, topic: str, data: bytes, log_ns: int) -> None:
        """Write a message, or the stored part of the frame before it."""
        if topic == form.FRAME:
            frame = json.loads(data)
            self.finish_film(ended=frame["index"] == 0)
            self._waiting, self._image = (frame, log_ns), None
        elif topic == form.IMAGE and self._waiting is not None:
            self._image = data
        else:
            super().log(topic, data, log_ns)

    def finish_film(self, *, ended: bool) -> None:
        """Write the frame that was held back; `ended`: it is the last of its film."""
        if self._waiting is None:
            return
        (frame, log_ns), data, self._waiting = self._waiting, self._image, None
        if data is not None:  # else the disk had no room for it
            image = image_of(data)
            stored, blank = self._band.keep(frame["index"], frame["t_s"], image, last=ended)
            if blank is not None:
                frame["blank"] = blank
                message = RawImage.FromString(data)
                message.data = stored.tobytes()
                data = message.SerializeToString()
        super().log(form.FRAME, json.dumps(frame).encode(), log_ns)
        if data is not None:
            super().log(form.IMAGE, data, log_ns)


def keep_band(source: Path, target: Path, setup: VisionSetup, counts: Mapping[str, int]) -> None:
    """Copy a recording with bands in place of full frames, and verify the copy.

    source  a complete recording with full frames
    counts  messages that it has, by topic
    raises  TornRecordingError: it lacks something; OSError; FileExistsError: there is a target
    """
    copy = _BandCopy(target, setup)
    try:
        copy.take_all(source)
        copy.finish_film(ended=True)
        if not copy.complete or copy.bad_bytes or copy.counts != counts:
            raise TornRecordingError(f"{source} is not what was written")
        copy.close(copy.closed)
    finally:
        copy.sink.close()
    verify(target, counts)


if __name__ == "__main__":  # as the recorder's process has it done
    reuse_freed_memory()
    gc.disable()  # nothing here refers to itself in a circle
    try:
        setup = pickle.load(sys.stdin.buffer)
        keep_band(Path(sys.argv[1]), Path(sys.argv[2]), setup, json.loads(sys.argv[3]))
    except (TornRecordingError, OSError) as error:
        sys.exit(str(error))
