"""Raw measurements of a calibration, as folders: pictures, poses, filmed motions."""

from __future__ import annotations

import csv
import errno
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem
from cell.files.words import counted
from drivers.interfaces import Image, Pose, Trajectory

_POSES, _COMMANDED, _GRIPPER, _DETECTED = "poses.csv", "told.csv", "hand.csv", "seen.csv"
_POSE_COLUMNS = ("picture", "role", "x_m", "y_m", "angle_rad")
_PATH_COLUMNS, _DETECTED_COLUMNS = ("t_s", "x_m", "y_m", "angle_rad"), ("stamp_s", "x_m", "y_m")
_WITHOUT = "without_thread.png"
_PICTURES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm")

#: Largest distance of a gripper from its home, m: a larger number is in millimetres.
FARTHEST_M = 10.0


@dataclass(frozen=True, eq=False)
class NamedImage:
    """A picture and its name."""

    name: str
    image: Image


@dataclass(frozen=True, eq=False)
class ShownPose:
    """The gripper at rest: `role` is fit or held_out; pose as the arm measured it."""

    role: str
    pose: Pose
    picture: NamedImage

    @property
    def mirrored(self) -> ShownPose:
        """The same with a mirrored picture."""
        turned = np.ascontiguousarray(self.picture.image[:, ::-1])
        return replace(self, picture=NamedImage(self.picture.name, turned))


@dataclass(frozen=True, eq=False)
class ShownCell:
    """All poses, and pictures of a plumb line.

    threads  one picture for each place of the plumb line
    without  the same scene without it; None = no plumb line
    """

    poses: tuple[ShownPose, ...]
    threads: tuple[Image, ...] = ()
    without: Image | None = None


@dataclass(frozen=True, eq=False)
class DetectedMove:
    """A motion as commanded, as measured, and as detected by the camera at its stamps."""

    commanded: Trajectory
    gripper_log: Trajectory
    stamps_s: FloatArray
    detected_m: FloatArray


def save_pictures(folder: Path, pictures: Sequence[NamedImage]) -> None:
    """Write pictures as PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    for picture in pictures:
        _save(folder / picture.name, picture.image)


def read_pictures(folder: Path) -> tuple[NamedImage, ...]:
    """All pictures of a folder, by name.  Raises InputError: there are none, or not readable."""
    if not folder.is_dir():
        raise InputError([Problem(folder, 1, None, "", "is no folder; give one with pictures")])
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in _PICTURES)
    if not paths:
        raise InputError([Problem(folder, 1, None, "", "has no pictures (PNG, TIFF, JPEG)")])
    return tuple(NamedImage(path.name, _read(path)) for path in paths)


def save_cell(folder: Path, shown: ShownCell) -> None:
    """Write poses and pictures."""
    save_pictures(folder, [one.picture for one in shown.poses])
    rows = [
        (one.picture.name, one.role, one.pose.x_m, one.pose.y_m, one.pose.angle_rad)
        for one in shown.poses
    ]
    _write(folder / _POSES, _POSE_COLUMNS, rows)
    if shown.without is not None:
        for number, image in enumerate(shown.threads, 1):
            _save(_thread(folder, number), image)
        _save(folder / _WITHOUT, shown.without)


def read_cell(folder: Path) -> ShownCell:
    """The poses and pictures that `save_cell` wrote.  Raises InputError."""
    poses = []
    table = folder / _POSES
    for line, row in _rows(table, _POSE_COLUMNS):
        name, role = row[0], row[1]
        if role not in ("fit", "held_out"):
            raise _wrong(table, line, f"{role!r} must be fit or held_out", "role")
        x, y, angle = _numbers(table, line, row[2:])
        if max(abs(x), abs(y)) > FARTHEST_M:
            message = f"the gripper is at ({x:g}, {y:g}) m; give metres, not millimetres"
            raise _wrong(table, line, message)
        if abs(angle) > 2.0 * np.pi:
            raise _wrong(table, line, f"{angle:g} rad; give radians, not degrees", "angle_rad")
        poses.append(ShownPose(role, Pose(x, y, angle), NamedImage(name, _read(folder / name))))
    present = itertools.takewhile(Path.exists, (_thread(folder, k) for k in itertools.count(1)))
    threads = tuple(_read(path) for path in present)
    return ShownCell(tuple(poses), threads, _read(folder / _WITHOUT) if threads else None)


def _thread(folder: Path, number: int) -> Path:
    """File of the plumb line at its `number`-th place, from 1."""
    return folder / ("thread.png" if number == 1 else f"thread_{number}.png")


def save_move(folder: Path, move: DetectedMove) -> None:
    """Write a motion."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, path in ((_COMMANDED, move.commanded), (_GRIPPER, move.gripper_log)):
        table = np.column_stack([path.t_s, path.x_m, path.y_m, path.angle_rad])
        _write(folder / name, _PATH_COLUMNS, table.tolist())
    detected = np.column_stack([move.stamps_s, move.detected_m])
    _write(folder / _DETECTED, _DETECTED_COLUMNS, detected.tolist())


def read_move(folder: Path) -> DetectedMove:
    """The motion that `save_move` wrote.  Raises InputError."""
    path, log, frames = (
        np.array([numbers(folder / name, line, row) for line, row in _rows(folder / name, header)])
        for name, header, numbers in (
            (_COMMANDED, _PATH_COLUMNS, _numbers),
            (_GRIPPER, _PATH_COLUMNS, _numbers),
            (_DETECTED, _DETECTED_COLUMNS, _detection),
        )
    )
    return DetectedMove(Trajectory(*path.T), Trajectory(*log.T), frames[:, 0], frames[:, 1:])


def _detection(path: Path, line: int, cells: Sequence[str]) -> list[float]:
    """Stamp and place of a frame; nan, nan where the jaw was not detected."""
    if all(cell.lower() == "nan" for cell in cells[1:]):
        return [*_numbers(path, line, cells[:1]), np.nan, np.nan]
    return _numbers(path, line, cells)


def _save(path: Path, image: Image) -> None:
    """Raises OSError: it cannot be written, which OpenCV reports by its result only."""
    if not cv2.imwrite(str(path), image):
        raise OSError(errno.EIO, "picture cannot be written", str(path))


def _read(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise InputError([Problem(path, 1, None, "", "is missing or no picture")])
    return np.asarray(image, dtype=np.uint8)


def _write(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def _rows(path: Path, header: Sequence[str]) -> list[tuple[int, list[str]]]:
    """Lines of a table and their cells in the order of `header`, which its first line names."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [(n, row) for n, row in enumerate(csv.reader(file), 1) if any(row)]
    except (OSError, ValueError, csv.Error) as error:
        why = error.strerror if isinstance(error, OSError) else "is not UTF-8 text with commas"
        raise _wrong(path, 1, f"cannot be read: {why}; check the name and the file") from error
    names = [cell.strip() for cell in lines[0][1]] if lines else []
    if sorted(names) != sorted(header):
        raise _wrong(path, 1, f"must begin with the line {','.join(header)}")
    for number, row in lines:
        if len(row) != len(names):
            message = (
                f"has {counted(len(row), 'column')}, {len(names)} are needed; mend it "
                "or record again"
            )
            raise _wrong(path, number, message)
    if len(lines) < 2:
        raise _wrong(path, 1, "has no rows")
    order = [names.index(name) for name in header]
    return [(number, [row[i].strip() for i in order]) for number, row in lines[1:]]


def _numbers(path: Path, line: int, cells: Sequence[str]) -> list[float]:
    try:
        values = [float(cell) for cell in cells]
    except ValueError as error:
        raise _wrong(path, line, f"{error}; give numbers") from error
    if not np.all(np.isfinite(values)):
        raise _wrong(path, line, "has a number that is not finite; give numbers")
    return values


def _wrong(path: Path, line: int, message: str, key: str = "") -> InputError:
    return InputError([Problem(path, line, None, key, message)])
