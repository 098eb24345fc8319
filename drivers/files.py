"""A camera that replays pictures from a folder, and the writer of such folders.

A recording is a folder of grey pictures in any format that OpenCV reads without loss.
`frames.csv` next to them, with the columns `file,t_s`, gives their order and their times
(mid-exposure, seconds, increasing).  Without it the pictures are read in the order of their
names, at an even frame rate.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path as FilePath

import cv2
import numpy as np

from drivers.interfaces import CameraError, Clock, ConnectError, Frame, Image

TIMES_FILE = "frames.csv"
#: Suffixes of pictures.
PICTURES = frozenset({".png", ".bmp", ".tif", ".tiff", ".pgm", ".jpg", ".jpeg"})


@dataclass(frozen=True)
class _Picture:
    file: FilePath
    t_s: float


class FilesCamera:
    """Replays a recording; each `start` continues after the end of the last one.

    folder         pictures, see above
    frame_rate_hz  rate of pictures without `frames.csv`; with it, the rate follows from it
    clock          None = frames keep the times of the recording and come at once; else the first
                   frame of a `start` is exposed now, and the others come after their own delays
    """

    def __init__(
        self,
        folder: FilePath,
        frame_rate_hz: float | None = None,
        clock: Clock | None = None,
        name: str = "camera",
    ) -> None:
        self.name = name
        self._folder = folder
        self._default_rate_hz = frame_rate_hz
        self._clock = clock
        self._pictures: tuple[_Picture, ...] = ()
        self._rate_hz = frame_rate_hz or 0.0
        self._begin = self._next = self._end = 0
        self._shift_s = 0.0

    @property
    def frame_rate_hz(self) -> float:
        """Rate of the recording, Hz; 0 before `connect` if `frames.csv` defines it."""
        return self._rate_hz

    @property
    def remaining(self) -> int:
        """Number of unread pictures."""
        return len(self._pictures) - self._next

    def connect(self) -> None:
        """Raises ConnectError: no folder, no pictures, bad `frames.csv`, no rate."""
        self._pictures = self._list()
        self._begin = self._next = self._end = 0
        if len(self._pictures) > 1:
            steps_s = np.diff([p.t_s for p in self._pictures])
            self._rate_hz = 1.0 / float(np.median(steps_s))

    def close(self) -> None:
        """Forget the recording."""
        self._pictures = ()
        self.stop()

    def check(self) -> None:
        """Files do not get lost."""

    def start(self, frame_count: int) -> None:
        """Raises CameraError: fewer pictures remain."""
        remaining = self.remaining
        if not 1 <= frame_count <= remaining:
            raise CameraError(
                self.name,
                f"{frame_count} frames asked for, {remaining} of {len(self._pictures)} pictures "
                f"are left in {self._folder}",
                "record more, or connect again to begin anew",
            )
        self._begin, self._end = self._next, self._next + frame_count
        if self._clock is not None:
            self._shift_s = self._clock.now_s() - self._pictures[self._begin].t_s

    def read(self) -> Frame | None:
        """Raises CameraError: a picture cannot be read."""
        if self._next >= self._end:
            return None
        picture = self._pictures[self._next]
        image = cv2.imread(str(picture.file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CameraError(self.name, f"{picture.file} is not a picture", "remove or replace it")
        t_s = picture.t_s + self._shift_s
        if self._clock is not None:
            self._clock.sleep_s(max(0.0, t_s - self._clock.now_s()))
        index = self._next - self._begin
        self._next += 1
        return Frame(index, t_s, np.asarray(image, dtype=np.uint8))

    def stop(self) -> None:
        """Drop the pictures of this recording that were not read."""
        self._next = self._begin = self._end

    def _list(self) -> tuple[_Picture, ...]:
        if not self._folder.is_dir():
            raise ConnectError(self.name, f"{self._folder} is not a folder", "give one of pictures")
        times = self._folder / TIMES_FILE
        if times.exists():
            pictures = self._listed_in(times)
        elif self._default_rate_hz is None:
            raise ConnectError(
                self.name, f"{times} is missing", "write it, or give the frame rate of the pictures"
            )
        else:
            files = sorted(f for f in self._folder.iterdir() if f.suffix.lower() in PICTURES)
            pictures = tuple(_Picture(f, i / self._default_rate_hz) for i, f in enumerate(files))
        if not pictures:
            raise ConnectError(self.name, f"{self._folder} holds no pictures", "give another one")
        return pictures

    def _listed_in(self, times: FilePath) -> tuple[_Picture, ...]:
        pictures: list[_Picture] = []
        with times.open(newline="") as rows:
            reader = csv.DictReader(rows)
            if not {"file", "t_s"} <= set(reader.fieldnames or ()):
                raise ConnectError(self.name, f"{times}:1: needs the columns file,t_s")
            for row in reader:
                where = f"{times}:{reader.line_num}"
                file = self._folder / (row["file"] or "")
                try:
                    t_s = float(row["t_s"])
                except (TypeError, ValueError):
                    raise ConnectError(
                        self.name, f"{where}: t_s = {row['t_s']!r} is not a number"
                    ) from None
                if not file.is_file():
                    raise ConnectError(self.name, f"{where}: {file} is missing")
                if not np.isfinite(t_s) or (pictures and t_s <= pictures[-1].t_s):
                    raise ConnectError(self.name, f"{where}: t_s = {t_s} s, times must increase")
                pictures.append(_Picture(file, t_s))
        return tuple(pictures)


def video_frames(file: FilePath, frame_rate_hz: float | None = None) -> tuple[float, list[Frame]]:
    """Rate in Hz and frames of a video in any format that OpenCV reads; the first at 0 s.

    frame_rate_hz  None = that of the file
    raises         ConnectError: it is no video, or has no rate
    """
    video = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG)
    try:
        rate_hz = frame_rate_hz or video.get(cv2.CAP_PROP_FPS)
        if not video.isOpened():
            raise ConnectError("camera", f"{file} is no video", "give one, or a folder of pictures")
        if not rate_hz > 0.0:
            raise ConnectError("camera", f"{file} says no frame rate", "give it")
        frames: list[Frame] = []
        while True:
            success, image = video.read()
            if not success:
                return rate_hz, frames
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            frames.append(Frame(len(frames), len(frames) / rate_hz, np.asarray(grey, np.uint8)))
    finally:
        video.release()


def write_frames(folder: FilePath, frames: Iterable[Frame]) -> None:
    """Write a recording that `FilesCamera` replays: PNG files, and `frames.csv` line by line."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / TIMES_FILE).open("w", newline="") as rows:
        writer = csv.writer(rows)
        writer.writerow(["file", "t_s"])
        for frame in frames:
            name = f"frame_{frame.index:06d}.png"
            write_picture(folder / name, frame.image)
            writer.writerow([name, f"{frame.t_s:.6f}"])


def write_picture(file: FilePath, image: Image) -> None:
    """Write one picture.  Raises OSError: the disk is full, or the folder is missing."""
    if not cv2.imwrite(str(file), image):
        raise OSError(f"{file} could not be written")
