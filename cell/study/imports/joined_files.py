"""Joins files of one motion: one per frame or point, or a separate one of the gripper's angle."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture
from cell.study.imports.contents import HAND, contents
from cell.study.imports.delimited import MIN_FRAMES
from cell.study.imports.long_tables import names_points
from cell.study.imports.read import read_frames

#: Times that differ by less than this fraction of a row are equal; minimum points of a motion.
_SAME_TIME = 0.01
_MIN_POINTS = 3
#: Maximum ratio of the number of all times to that of the shortest file, which lost frames.
_RATIO = 2


def joined(captures: Sequence[Capture]) -> Capture:
    """Merge the columns of files of one recording; equal names get their file's label as prefix.

    At times that a file lacks, its values are nan.

    raises  InputError: a file has times between those of the others
    """
    if (numbers := frame_numbers(captures)) is not None:
        order = np.argsort(numbers)
        paths = [captures[i].path for i in order]
        return read_frames(paths, sorted(numbers), captures[0].form)
    first, labels = captures[0], _labels([c.path for c in captures])
    time = contents(first).time or ""
    all_names = [name for c in captures for name in c.names if name != time]
    times, indices = _grid([c.column(time) for c in captures])
    columns, values, notes = [first.columns[first.names.index(time)]], [times], list[str]()
    lines = np.full(len(times), first.lines[-1], dtype=np.intp)
    lines[indices[0]] = first.lines
    for capture, label, rows in zip(captures, labels, indices, strict=True):
        if not on_one_grid([first, capture]):
            message = f"has not the times of {first.path.name}, with which it is to be joined; "
            raise capture.error(0, f"{message}give files of one recording")
        for column, series in zip(capture.columns, capture.values.T, strict=True):
            if column.name == time:
                continue
            ambiguous = all_names.count(column.name) > 1
            columns.append(replace(column, name=f"{label} {column.name}") if ambiguous else column)
            values.append(np.full(len(times), np.nan))
            values[-1][rows] = series
        notes += capture.notes
    return replace(
        first, columns=tuple(columns), values=np.column_stack(values), lines=lines,
        notes=tuple(notes),
    )  # fmt: skip


def frame_numbers(captures: Sequence[Capture]) -> list[int] | None:
    """Numbers in the files' names, if every file holds the points of one frame; else None.

    Files that have more rows than there are files hold the frames of one point each.
    """
    names = [re.findall(r"\d+", c.path.stem) for c in captures]
    numbers = [n for n in zip(*names, strict=False) if len(set(map(int, n))) == len(n)]
    few = len(captures) < max(MIN_FRAMES, *(len(c.values) for c in captures))
    if few or not numbers or not all(map(_is_frame, captures)):
        return None
    return [int(n) for n in numbers[-1]]


def _is_frame(capture: Capture) -> bool:
    """Whether rows are points of one time: a table of one time, or of one point without times."""
    inside = contents(capture)
    if capture.form is None or inside.has_gripper_sensor:
        return False
    if inside.time is None or (inside.counts and names_points(inside.time)):
        return len(inside.points) == 1
    return bool(np.ptp(capture.column(inside.time)) == 0.0)


def on_one_grid(captures: Sequence[Capture]) -> bool:
    """Whether files have time columns of equal name, and no times between those of another file."""
    names = {contents(c).time for c in captures}
    name = next(iter(names))
    if len(names) > 1 or name is None:
        return False
    stamps = [c.column(name) for c in captures]
    rising = all(np.isfinite(t).all() and np.all(np.diff(t) > 0.0) and len(t) > 1 for t in stamps)
    if not rising:
        return False
    step = min(float(np.median(np.diff(t))) for t in stamps)
    times, _ = _grid(stamps)
    return bool(np.diff(times).min() > 0.5 * step and len(times) < _RATIO * min(map(len, stamps)))


def _grid(time_columns: Sequence[FloatArray]) -> tuple[FloatArray, list[NDArray[np.intp]]]:
    """Times of all files without repeats, and the index of each file's times among them."""
    stamps = np.sort(np.concatenate(time_columns))
    step = float(np.median(np.diff(time_columns[0]))) if len(time_columns[0]) > 1 else 0.0
    times = stamps[np.append(True, np.diff(stamps) > _SAME_TIME * abs(step))]
    indices = [np.searchsorted(times, t, side="right") - 1 for t in time_columns]
    return times, indices


def motions(captures: Sequence[Capture], gripper_elsewhere: bool = False) -> list[list[int]]:
    """Indices of the files of each motion, if every file holds one frame or point; else empty.

    Motions differ by folder; those of points also by the first or last words of their files' names,
    of which the other words name the point.  One point must be named after the gripper, unless that
    is in other files.
    """
    folders: dict[Path, list[int]] = {}
    for i, capture in enumerate(captures):
        folders.setdefault(capture.path.parent, []).append(i)
    if all(frame_numbers([captures[i] for i in each]) for each in folders.values()):
        return list(folders.values())
    contents_list = [contents(c) for c in captures]
    single = all(len(i.points) == 1 and not i.has_gripper_sensor for i in contents_list)
    if len(captures) < _MIN_POINTS or not single:
        return []
    words, best = [tuple(_words(c.path)) for c in captures], list[list[int]]()
    for motion_keys, point_keys in _splits([c.path for c in captures], words):
        groups: dict[tuple[str, ...], list[int]] = {}
        for i, motion in enumerate(motion_keys):
            groups.setdefault(motion, []).append(i)
        points = [sorted(point_keys[i] for i in group) for group in groups.values()]
        has_gripper = gripper_elsewhere or any(HAND.intersection(label) for label in points[0])
        same_points = all(p == points[0] for p in points) and len(set(points[0])) >= _MIN_POINTS
        if len(groups) > len(best) and has_gripper and same_points and all(
            on_one_grid([captures[i] for i in group]) for group in groups.values()
        ):  # fmt: skip
            best = list(groups.values())
    return best


_Words = tuple[str, ...]


def _splits(
    paths: Sequence[Path], words: Sequence[_Words]
) -> Iterator[tuple[list[_Words], list[_Words]]]:
    """Candidate splits of each file's words into those of the motion and those of the point."""
    yield [(str(path.parent),) for path in paths], list(words)
    for count in range(min(map(len, words))):
        yield [w[:count] for w in words], [w[count:] for w in words]
        yield [w[len(w) - count :] for w in words], [w[: len(w) - count] for w in words]


def tells_only_turns(hand: Capture, markers: Capture) -> bool:
    """Whether the gripper's file has orientations only, and the markers' file its position."""
    gripper = contents(hand)
    has_orientation = bool(gripper.quaternions or gripper.angles)
    if gripper.points or gripper.has_gripper_sensor or not has_orientation:
        return False
    same_times = len(markers.values) == len(hand.values) and on_one_grid([markers, hand])
    return same_times and any(p.on_gripper for p in contents(markers).points)


def _words(path: Path) -> list[str]:
    return [w for w in re.split(r"[\W_]+", path.stem.lower()) if w]


def _labels(paths: Sequence[Path]) -> list[str]:
    """Distinct part of each file name, without the first and last words common to all."""
    pieces = [re.split(r"[\W_]+", path.stem) for path in paths]
    prefix = _common_start(pieces)
    suffix = _common_start([words[::-1] for words in pieces])
    distinct = (" ".join(words[prefix : len(words) - suffix]) for words in pieces)
    return [label or path.stem for label, path in zip(distinct, paths, strict=True)]


def _common_start(pieces: Sequence[Sequence[str]]) -> int:
    """Number of first words that are common to all."""
    columns = zip(*pieces, strict=False)
    return next((i for i, c in enumerate(columns) if len(set(c)) > 1), min(map(len, pieces)))
