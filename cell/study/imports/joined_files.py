"""Files of one motion that are joined: a point each, or a gripper's angle alone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.study.imports.capture import Capture
from cell.study.imports.contents import HAND, contents

#: Times of one recording differ by less than this share of a row; fewest points of a motion.
_SAME_TIME = 0.01
_FEWEST = 3


def joined(captures: Sequence[Capture]) -> Capture:
    """The columns of files with the same times; those of one name are called after their files.

    raises  InputError: a file has other times than the first
    """
    first, labels = captures[0], _labels([c.path for c in captures])
    time = contents(first).time
    each = [name for c in captures for name in c.names if name != time]
    columns, values, notes = [], [], list[str]()
    for capture, label in zip(captures, labels, strict=True):
        if not same_times(first, capture):
            message = f"has not the times of {first.path.name}, with which it is to be joined; "
            raise capture.error(0, f"{message}give files of one recording")
        for i, column in enumerate(capture.columns):
            if column.name == time and capture is not first:
                continue
            shared = column.name != time and each.count(column.name) > 1
            columns.append(replace(column, name=f"{label} {column.name}") if shared else column)
            values.append(capture.values[:, i])
        notes += capture.notes
    return replace(
        first, columns=tuple(columns), values=np.column_stack(values), notes=tuple(notes)
    )


def same_times(one: Capture, other: Capture) -> bool:
    """Whether two files have a row at each of the same times, in a column of the same name."""
    name = contents(one).time
    if name is None or name != contents(other).time or len(one.values) != len(other.values):
        return False
    t, u = one.column(name), other.column(name)
    step = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    return bool(np.allclose(t, u, rtol=0.0, atol=_SAME_TIME * abs(step)))


def motions(captures: Sequence[Capture]) -> list[list[int]]:
    """Places of the files that show one motion together, if each shows one point of it; else empty.

    Several motions have names of their own at the beginning or the end of their files' names, and
    the points' names at the other end.
    """
    inside = [contents(c) for c in captures]
    single = all(len(i.points) == 1 and not i.has_gripper_sensor for i in inside)
    if len(captures) < _FEWEST or not single:
        return []
    words = [_words(c.path) for c in captures]
    for of_motion, of_point in ((slice(None, -1), slice(-1, None)), (slice(1, None), slice(1))):
        groups: dict[tuple[str, ...], list[int]] = {}
        for i, found in enumerate(words):
            groups.setdefault(tuple(found[of_motion]), []).append(i)
        points = [sorted(words[i][of_point] for i in of) for of in groups.values()]
        named = any(HAND.intersection(label) for label in points[0])
        alike = all(p == points[0] for p in points) and len(points[0]) >= _FEWEST
        together = all(same_times(captures[of[0]], captures[i])
                       for of in groups.values() for i in of)  # fmt: skip
        if named and alike and together:
            return list(groups.values())
    return []


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
