"""Files of one motion that are joined: a point each, or a gripper's angle alone."""

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

#: Times of one recording differ by less than this share of a row; fewest points of a motion.
_SAME_TIME = 0.01
_FEWEST = 3
#: Times of all files are fewer than so many times those of one: others lose frames.
_MOST_LOST = 2


def joined(captures: Sequence[Capture]) -> Capture:
    """The columns of files of one recording; those of one name are called after their files.

    A time that a file has not is one at which its points are not seen.

    raises  InputError: a file has times between those of the others
    """
    first, labels = captures[0], _labels([c.path for c in captures])
    time = contents(first).time or ""
    each = [name for c in captures for name in c.names if name != time]
    times, places = _grid([c.column(time) for c in captures])
    columns, values, notes = [first.columns[first.names.index(time)]], [times], list[str]()
    lines = np.full(len(times), first.lines[-1], dtype=np.intp)
    lines[places[0]] = first.lines
    for capture, label, place in zip(captures, labels, places, strict=True):
        if not on_one_grid([first, capture]):
            message = f"has not the times of {first.path.name}, with which it is to be joined; "
            raise capture.error(0, f"{message}give files of one recording")
        for column, series in zip(capture.columns, capture.values.T, strict=True):
            if column.name == time:
                continue
            shared = each.count(column.name) > 1
            columns.append(replace(column, name=f"{label} {column.name}") if shared else column)
            values.append(np.full(len(times), np.nan))
            values[-1][place] = series
        notes += capture.notes
    return replace(
        first, columns=tuple(columns), values=np.column_stack(values), lines=lines,
        notes=tuple(notes),
    )  # fmt: skip


def on_one_grid(captures: Sequence[Capture]) -> bool:
    """Whether files have a column of times of one name, and no time between those of another."""
    names = {contents(c).time for c in captures}
    name = next(iter(names))
    if len(names) > 1 or name is None:
        return False
    each = [c.column(name) for c in captures]
    rise = all(np.isfinite(t).all() and np.all(np.diff(t) > 0.0) and len(t) > 1 for t in each)
    if not rise:
        return False
    step = min(float(np.median(np.diff(t))) for t in each)
    times, _ = _grid(each)
    return bool(np.diff(times).min() > 0.5 * step and len(times) < _MOST_LOST * min(map(len, each)))


def _grid(each: Sequence[FloatArray]) -> tuple[FloatArray, list[NDArray[np.intp]]]:
    """Times of all, those of one row once, and the places of each among them."""
    every = np.sort(np.concatenate(each))
    step = float(np.median(np.diff(each[0]))) if len(each[0]) > 1 else 0.0
    times = every[np.append(True, np.diff(every) > _SAME_TIME * abs(step))]
    places = [np.searchsorted(times, t, side="right") - 1 for t in each]
    return times, places


def same_times(one: Capture, other: Capture) -> bool:
    """Whether two files have a row at each of the same times, in a column of the same name."""
    return len(one.values) == len(other.values) and on_one_grid([one, other])


def motions(captures: Sequence[Capture], gripper_elsewhere: bool = False) -> list[list[int]]:
    """Places of the files that show one motion together, if each shows one point of it; else empty.

    Several motions have folders, or words of their own at the beginning or the end of their files'
    names, and the points' words at the other end.  A point is named after the gripper, unless this
    is in other files.
    """
    inside = [contents(c) for c in captures]
    single = all(len(i.points) == 1 and not i.has_gripper_sensor for i in inside)
    if len(captures) < _FEWEST or not single:
        return []
    words, best = [tuple(_words(c.path)) for c in captures], list[list[int]]()
    for of_motion, of_point in _splits([c.path for c in captures], words):
        groups: dict[tuple[str, ...], list[int]] = {}
        for i, motion in enumerate(of_motion):
            groups.setdefault(motion, []).append(i)
        points = [sorted(of_point[i] for i in of) for of in groups.values()]
        named = gripper_elsewhere or any(HAND.intersection(label) for label in points[0])
        alike = all(p == points[0] for p in points) and len(set(points[0])) >= _FEWEST
        if len(groups) > len(best) and named and alike and all(
            on_one_grid([captures[i] for i in of]) for of in groups.values()
        ):  # fmt: skip
            best = list(groups.values())
    return best


_Words = tuple[str, ...]


def _splits(
    paths: Sequence[Path], words: Sequence[_Words]
) -> Iterator[tuple[list[_Words], list[_Words]]]:
    """Words of the motion and of the point of each file, as they may be told apart."""
    yield [(str(path.parent),) for path in paths], list(words)
    for count in range(min(map(len, words))):
        yield [w[:count] for w in words], [w[count:] for w in words]
        yield [w[len(w) - count :] for w in words], [w[: len(w) - count] for w in words]


def tells_only_turns(hand: Capture, markers: Capture) -> bool:
    """Whether a gripper's file has its orientation alone, and that of the markers its place."""
    inside = contents(hand)
    turns = bool(inside.quaternions or inside.angles)
    if inside.points or inside.has_gripper_sensor or not turns:
        return False
    return any(p.on_gripper for p in contents(markers).points) and same_times(markers, hand)


def _words(path: Path) -> list[str]:
    return [w for w in re.split(r"[\W_]+", path.stem.lower()) if w]


def _labels(paths: Sequence[Path]) -> list[str]:
    """What the names of files have of their own, without what all begin or end with."""
    pieces = [re.split(r"[\W_]+", path.stem) for path in paths]
    before = _alike(pieces)
    behind = _alike([found[::-1] for found in pieces])
    own = (" ".join(found[before : len(found) - behind]) for found in pieces)
    return [label or path.stem for label, path in zip(own, paths, strict=True)]


def _alike(pieces: Sequence[Sequence[str]]) -> int:
    """How many words all begin with."""
    columns = zip(*pieces, strict=False)
    return next((i for i, c in enumerate(columns) if len(set(c)) > 1), min(map(len, pieces)))
