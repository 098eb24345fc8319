"""Content of a file by its column names: time, points, angles, quaternions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import ROW_NUMBER, Capture, CapturedColumn
from cell.study.imports.column_names import (
    DISPLACEMENT,
    ColumnKind,
    Meaning,
    meaning,
    with_axes_at_ends,
)
from cell.study.imports.units import RADIANS, SECONDS

#: Words for a gripper or another holder of the cable.
HAND = frozenset(
    ("hand", "grip", "gripper", "gripping", "clamp", "tcp", "tool", "robot", "flange", "ee",
     "effector", "base", "root", "mount", "greifer", "holder", "wrist", "shaker", "cart", "fixture",
     "chuck", "jaw", "jaws", "hub", "motor", "eef", "klemm", "klemme", "grp", "backe", "backen",
     "pince", "mors", "pinza", "roboter", "garra", "rob", "robi", "mordaza", "einspannung")
)  # fmt: skip


#: Range of the rates of films and logs, rows per second.
FILM_RATES_HZ = (2.0, 20_000.0)
#: The years 1998 … 2100, in s since 1970.
_EPOCH_RANGE_S = 0.9e9, 4.1e9
#: Largest share of backward steps in an unsorted column of times.
_BACKWARD_SHARE = 0.25
#: Largest mean step of a frame counter.
_MEAN_STEP = 1.5


@dataclass(frozen=True)
class Point:
    """A point with two or three coordinates in columns of one file.

    common  words common to the names of all points of the file: of a subject, or of the program
    """

    name: str
    columns: tuple[str, ...]
    unit: str
    common: frozenset[str] = frozenset()

    @property
    def on_gripper(self) -> bool:
        """Whether its name, without the common words, contains a word for a gripper."""
        own = set(self.name.split()) - self.common
        return bool(HAND.intersection(word.rstrip("0123456789") for word in own))


@dataclass(frozen=True)
class Contents:
    """Content of a file by its column names.

    time         name of the column of times, else of frame numbers; None = there is none
    counts       whether `time` holds frame numbers
    angles       columns of angles, with the meanings of their names
    quaternions  x, y, z, w of bodies, by name
    encoders     columns of encoders, with the meanings of their names
    accelerations  columns of one accelerometer by axis, x first; empty = there is none
    unused       all other columns
    """

    time: str | None
    time_unit: str
    counts: bool
    points: tuple[Point, ...]
    angles: tuple[tuple[str, Meaning], ...]
    quaternions: tuple[tuple[str, tuple[str, str, str, str]], ...]
    encoders: tuple[tuple[str, Meaning], ...]
    accelerations: tuple[tuple[str, Meaning], ...]
    unused: tuple[str, ...]

    @property
    def has_gripper_sensor(self) -> bool:
        """Whether the file has a sensor of the gripper, but not its position."""
        by_sensor = bool(self.encoders or self.accelerations)
        return by_sensor and not any(p.on_gripper for p in self.points)

    def point(self, name: str) -> Point | None:
        """The point of a name; None = there is none."""
        return next((p for p in self.points if p.name == name), None)


def contents(capture: Capture) -> Contents:
    """Columns of a file, classified by their names and units."""
    meanings = with_axes_at_ends([(c.name, meaning(c)) for c in capture.columns])
    if all(m.kind is not ColumnKind.TIME for _, m in meanings):
        meanings = [_since_1970(capture, n, m) for n, m in meanings]
    times = [(n, m) for n, m in meanings
             if m.kind is ColumnKind.TIME and np.isfinite(capture.column(n)).any()]  # fmt: skip
    frames = [(n, m) for n, m in meanings if m.kind is ColumnKind.FRAME]
    rising = [(n, m) for n, m in times if _rises(capture, n)]
    rising.sort(key=lambda column: "header" not in column[1].group.split())  # stamped by its sensor
    counted = [(n, m) for n, m in frames if _rises(capture, n)]
    chosen = (rising or counted or times or frames)[:1]
    if not chosen and meanings and _counts_rows(capture, *meanings[0]):
        chosen = frames = [(meanings[0][0], replace(meanings[0][1], kind=ColumnKind.FRAME))]
    points, others = _points(capture, meanings)
    quaternions = _quaternions(meanings)
    of_quaternions = {n for _, four in quaternions for n in four}
    angles = tuple(
        (n, m) for n, m in meanings if m.kind is ColumnKind.ANGLE and n not in of_quaternions
    )
    markers = {p.name for p in points if not p.on_gripper}
    encoders = tuple((n, m) for n, m in meanings if m.kind is ColumnKind.ENCODER
                     and not any(n.startswith(f"{name} ") for name in markers))  # fmt: skip
    accelerations = _accelerations(meanings, markers)
    if any(p.on_gripper for p in points):  # then an encoder can only measure its angle
        angles += tuple((n, m) for n, m in encoders if m.unit in RADIANS)
    used = {n for n, _ in encoders + accelerations}
    used |= {n for p in points for n in p.columns} | {n for n, _ in chosen} | {n for n, _ in angles}
    used |= of_quaternions | {n for n, _ in times + frames}
    return Contents(
        chosen[0][0] if chosen else None,
        chosen[0][1].unit if chosen else "",
        bool(chosen) and chosen[0][1].kind is ColumnKind.FRAME,
        points,
        angles,
        quaternions,
        encoders,
        accelerations,
        tuple(n for n, _ in meanings if n not in used) + tuple(others),
    )


def epoch_unit(times: FloatArray) -> str:
    """Unit of times (rows,) that count from 1970, by their magnitude; empty = they do not."""
    if len(times) < 2 or not np.isfinite(times).all() or not times[-1] > times[0]:
        return ""
    step = float(times[-1] - times[0]) / (len(times) - 1)
    (early_s, late_s), (low_hz, high_hz) = _EPOCH_RANGE_S, FILM_RATES_HZ
    for name in ("s", "ms", "µs", "ns"):
        unit = SECONDS[name]
        if early_s < times[0] * unit < late_s and low_hz <= 1.0 / (step * unit) <= high_hz:
            return name
    return ""


def on_one_clock(inside: Contents, capture: Capture, other: Contents, of: Capture) -> Contents:
    """The content of a file, with its times since 1970 if another file has no other times."""
    if None in (inside.time, other.time) or not epoch_unit(of.column(other.time or "")):
        return inside
    times = [c for c in capture.columns if meaning(c).kind is ColumnKind.TIME]
    since = [c for c in times if epoch_unit(capture.column(c.name))]
    if not since or any(c.name == inside.time for c in since):
        return inside
    return replace(inside, time=since[0].name, time_unit=meaning(since[0]).unit, counts=False)


def _since_1970(capture: Capture, name: str, by_name: Meaning) -> tuple[str, Meaning]:
    """A column, classified as time if its values are times since 1970."""
    of_no_kind = by_name.kind in (ColumnKind.FRAME, ColumnKind.OTHER) and not by_name.unit
    if of_no_kind and epoch_unit(capture.column(name)):
        by_name = replace(by_name, kind=ColumnKind.TIME)
    return name, by_name


def with_names(
    capture: Capture, wanted: Sequence[str], time: str | None
) -> tuple[Capture, dict[str, str]]:
    """The file with synonymous columns renamed to the wanted names, and their original names.

    Synonyms are `Tip/0/X` and `Tip X`, which different programs write for the same point.

    time  wanted name of the column of times; None = it keeps its own
    """
    missing = [n for n in wanted if n not in capture.names]
    free = [c for c in capture.columns if c.name not in wanted]
    wanted_meanings = with_axes_at_ends([(n, meaning(CapturedColumn(n))) for n in wanted])
    free_meanings = with_axes_at_ends([(c.name, meaning(c)) for c in free])
    originals: dict[str, str] = {}
    for name, target in wanted_meanings:
        synonyms = [n for n, m in free_meanings if _are_synonyms(m, target)]
        if name in missing and len(synonyms) == 1:
            originals[name] = synonyms[0]
    inside = contents(capture)
    if time is not None and inside.time and time not in (ROW_NUMBER, *capture.names):
        target = meaning(CapturedColumn(time))
        if (target.unit, target.kind is ColumnKind.TIME) == (inside.time_unit, not inside.counts):
            originals[time] = inside.time
    if len(set(originals.values())) < len(originals):
        return capture, {}
    names = {own: name for name, own in originals.items()}
    columns = tuple(replace(c, name=names.get(c.name, c.name)) for c in capture.columns)
    return replace(capture, columns=columns), originals


def _are_synonyms(first: Meaning, second: Meaning) -> bool:
    """Whether two names mean the same coordinate of one point or body."""
    groups = [" ".join(w for w in m.group.split() if w != "0") for m in (first, second)]
    same = (first.kind, first.axis, first.unit) == (second.kind, second.axis, second.unit)
    return same and groups[0] == groups[1] and bool(first.axis and groups[0])


def _accelerations(
    meanings: list[tuple[str, Meaning]], markers: set[str]
) -> tuple[tuple[str, Meaning], ...]:
    """Columns of the accelerometer named after a gripper, else of the first on no marker."""
    columns = [
        (n, m) for n, m in meanings if m.kind is ColumnKind.ACCELERATION and m.group not in markers
    ]
    groups = list(dict.fromkeys(m.group for _, m in columns))
    chosen = next((g for g in groups if HAND.intersection(g.split())), groups[0] if groups else "")
    return tuple(sorted(((n, m) for n, m in columns if m.group == chosen), key=lambda f: f[1].axis))


def _counts_rows(capture: Capture, name: str, by_name: Meaning) -> bool:
    """Whether a first column without a meaning counts frames, of which few are missing."""
    steps = np.diff(capture.column(name))
    if by_name.kind is not ColumnKind.OTHER or by_name.unit or not len(steps):
        return False
    is_integer = bool(np.all(steps >= 1.0) and np.all(steps == np.round(steps)))
    return is_integer and bool(np.median(steps) == 1.0 and steps.mean() < _MEAN_STEP)


def _rises(capture: Capture, name: str) -> bool:
    values = capture.column(name)
    steps = np.diff(values)
    rises = len(steps) > 0 and np.isfinite(values).all() and values[-1] > values[0]
    return bool(rises and np.mean(steps < 0.0) < _BACKWARD_SHARE)


def _points(
    capture: Capture, meanings: list[tuple[str, Meaning]]
) -> tuple[tuple[Point, ...], list[str]]:
    """Points with all their coordinates, and columns without a second coordinate."""
    groups: dict[str, dict[str, tuple[str, str]]] = {}
    for name, m in meanings:
        if m.kind is ColumnKind.COORDINATE:
            groups.setdefault(m.group, {}).setdefault(m.axis, (name, m.unit))
    points: list[Point] = []
    single: list[str] = []
    for group, axes in groups.items():
        base, _, last = group.rpartition(" ")
        if len(axes) < 2 or (last in DISPLACEMENT and base in groups):
            single += [name for name, _ in axes.values()]
            continue
        columns = tuple(axes[a][0] for a in "xyz" if a in axes)
        unit = next((u for _, u in axes.values() if u), capture.unit)
        name = f"marker {group}" if group.isdecimal() else group or "point"
        points.append(Point(name, columns, unit))
    if len(points) > 1:
        common = frozenset.intersection(*(frozenset(p.name.split()) for p in points))
        points = [replace(p, common=common) for p in points]
    return tuple(points), single


def _quaternions(
    meanings: list[tuple[str, Meaning]],
) -> tuple[tuple[str, tuple[str, str, str, str]], ...]:
    """Quaternion columns of bodies; some programs call them a rotation."""
    groups: dict[tuple[str, ColumnKind], dict[str, str]] = {}
    for name, m in meanings:
        if m.kind in (ColumnKind.QUATERNION, ColumnKind.ANGLE) and m.axis:
            groups.setdefault((m.group, m.kind), {}).setdefault(m.axis, name)
    return tuple(
        (group, (axes["x"], axes["y"], axes["z"], axes["w"]))
        for (group, _), axes in groups.items()
        if set(axes) >= set("xyzw")
    )
