"""Groups of arrays: trials within one file with their grippers, and names that texts give them."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.study.imports.capture import CapturedColumn
from cell.study.imports.column_names import ColumnKind, meaning, visibility
from cell.study.imports.contents import HAND
from cell.study.imports.row_trials import MAX_TRIALS, names_trials
from cell.study.imports.units import unit_of

#: Arrays by their path within a file, the outermost name first.
Tree = dict[tuple[str, ...], NDArray[Any]]
#: Units that a file states for its arrays.
Units = dict[tuple[str, ...], str]

#: Separators between a file and its part, and between the names of the part.
PART, WITHIN = "#", "."


@dataclass(frozen=True)
class FilePart:
    """A trial within a file.

    markers, gripper  names of the parts with these; an empty gripper = it is with the markers
    """

    name: str
    markers: str
    gripper: str = ""


def split_part(path: Path) -> tuple[Path, str]:
    """An existing file, and the part of it behind `#`; empty = the complete file."""
    file, mark, part = path.name.partition(PART)
    if not (mark and file and part) or path.exists() or not path.with_name(file).is_file():
        return path, ""
    return path.with_name(file), part


def with_part(path: Path, part: str) -> Path:
    """The path of a part of a file."""
    return path.with_name(f"{path.name}{PART}{part}") if part else path


def time_groups(tree: Mapping[tuple[str, ...], NDArray[Any]]) -> list[tuple[str, ...]]:
    """Groups that hold a series of times; without any, groups alike with several points."""
    if times := times_in(tree):
        return list(dict.fromkeys(key[:-1] for key in times))
    names: dict[tuple[str, ...], set[str]] = {}
    for key in tree:
        names.setdefault(key[:-1], set()).add(key[-1])
    of_points = dict.fromkeys(key[:-1] for key, values in tree.items() if _are_points(key, values))
    alike = [g for g in of_points if sum(names[g] == names[other] for other in of_points) > 1]
    return alike if len(alike) == len(of_points) else []


#: Words of an array of points, whose coordinates may stand one after the other in a row, and the
#: largest change of the distances of neighbours on a cable, as a share of these.
_OF_POINTS = frozenset(("keypoints", "points", "markers", "nodes", "landmarks", "dots", "tracks"))
_CHAIN_CHANGE = 0.1


def coordinates_in_rows(name: str, values: NDArray[Any]) -> int | None:
    """Number of coordinates, 2 or 3, of points that stand one after the other in a row.

    It is that under which neighbours keep their distances best, as on a cable.

    values   (rows, points · coordinates)
    returns  None = the array is not named after points, or these are no chain
    """
    width, changes = values.shape[1], dict[int, float]()
    for count in (3, 2):
        if width % count or width < 2 * count or not _OF_POINTS & _words((name,)):
            continue
        steps = np.diff(np.reshape(values, (len(values), -1, count)), axis=1)
        lengths = np.linalg.norm(steps, axis=2)
        known = lengths[np.isfinite(lengths).all(axis=1)]
        if len(known) and known.any():
            changes[count] = float(known.std(axis=0).sum() / known.mean(axis=0).sum())
    best = min(changes, key=lambda count: changes[count], default=None)
    return best if best is not None and changes[best] < _CHAIN_CHANGE else None


def _are_points(key: tuple[str, ...], values: NDArray[Any]) -> bool:
    """Whether an array holds places of several points."""
    flat = values.ndim == 2 and values.dtype.kind in "fiu"
    return values.ndim == 3 or (flat and coordinates_in_rows(key[-1], values) is not None)


def times_in(tree: Mapping[tuple[str, ...], NDArray[Any]]) -> list[tuple[str, ...]]:
    """Arrays that are series of times by their names."""
    return [
        key
        for key, values in tree.items()
        if values.dtype.kind in "fiu"
        and np.squeeze(values).ndim == 1
        and meaning(CapturedColumn(key[-1])).kind is ColumnKind.TIME
    ]


def apart_by_length(tree: Tree) -> Tree:
    """The arrays of groups with several times, each in a group with the times of its length.

    Such a group is named after the gripper if one of its arrays is, else after its times.
    """
    times: dict[tuple[str, ...], dict[int, str]] = {}
    for *group, name in times_in(tree):
        times.setdefault(tuple(group), {}).setdefault(tree[*group, name].size, name)
    grouped: Tree = {}
    for (*group, name), values in tree.items():
        of_length = times.get(tuple(group), {})
        length = next((n for n in values.shape if n in of_length), None)
        if len(of_length) < 2 or length is None:
            grouped[*group, name] = values
            continue
        members = (k[-1] for k, v in tree.items() if k[:-1] == tuple(group) and length in v.shape)
        title = next((n for n in members if HAND & _words((n,))), of_length[length])
        title = _without_axis(title)
        grouped[*group, title, name] = values
    return grouped


def _without_axis(name: str) -> str:
    """A name without its axis, which the names of a group's arrays would repeat."""
    by_name = meaning(CapturedColumn(name))
    return "_".join(by_name.group.split()) if by_name.axis and by_name.group else name


def within(tree: Tree, group: tuple[str, ...]) -> Tree:
    """Arrays of a group by their names in it, with the scalars and texts of the groups around it.

    Inner groups with their own times are excluded; a gripper's group keeps its name.
    """
    groups = time_groups(tree)
    inner = [g for g in groups if g != group and g[: len(group)] == group]
    hand = [name for name in group[-1:] if HAND & _words((name,))]

    def own_name(key: tuple[str, ...]) -> tuple[str, ...]:
        repeated = HAND & _words(group[-1:]) & _words(key[-1:])
        return (*(() if repeated else hand), *key[len(group) :])

    own = {
        own_name(key): values
        for key, values in tree.items()
        if key[: len(group)] == group and not any(key[: len(g)] == g for g in inner)
    }
    common = {
        key[-1:]: values
        for key, values in tree.items()
        if len(key) <= len(group) and key[:-1] == group[: len(key) - 1] and _is_remark(values)
    }
    return common | own


def _is_remark(values: NDArray[Any]) -> bool:
    """Whether an array is a scalar, or text."""
    return np.squeeze(values).ndim == 0 or values.dtype.kind in "OUS"


def trials_in(tree: Tree, shows_points: Callable[[tuple[str, ...]], bool]) -> list[FilePart] | None:
    """The trials of a file with several groups with times; empty = the file is one trial; None =
    the groups are ambiguous.

    shows_points  whether a group holds points
    """
    groups = time_groups(tree)
    if len(groups) < 2:
        return []
    common = frozenset.intersection(*(_words(g) for g in groups))
    hands = [g for g in groups if HAND & (_words(g) - common)]
    markers = [g for g in groups if g not in hands and shows_points(g)]
    if not markers or len({_structure(tree, g) for g in markers}) > 1:
        return None
    grippers = _pairs(markers, hands)
    if grippers is None:
        return None
    return [
        FilePart(_name(m, markers), WITHIN.join(m), WITHIN.join(g))
        for m, g in zip(markers, grippers, strict=True)
    ]


def group_of(tree: Tree, part: str) -> tuple[str, ...] | None:
    """The group that a part names; None = there is none."""
    return next((g for g in time_groups(tree) if WITHIN.join(g) == part), None)


def _pairs(
    markers: Sequence[tuple[str, ...]], hands: Sequence[tuple[str, ...]]
) -> list[tuple[str, ...]] | None:
    """The gripper's group of each of the markers' groups, by common names; None = no pairing."""
    if not hands:
        return [()] * len(markers)
    if len(markers) == len(hands) == 1:
        return list(hands)
    pairs: list[tuple[str, ...]] = []
    for group in markers:
        fitting = [h for h in hands if _words(h) - HAND <= _words(group)]
        if len(fitting) != 1 or fitting[0] in pairs:
            return None
        pairs += fitting
    return pairs if len(pairs) == len(hands) else None


def _structure(tree: Tree, group: tuple[str, ...]) -> frozenset[tuple[tuple[str, ...], int]]:
    """Names and dimensions of a group's series."""
    series = ((key, np.squeeze(values)) for key, values in within(tree, group).items())
    return frozenset((key, v.ndim) for key, v in series if v.ndim and v.dtype.kind in "fiub")


def _name(group: tuple[str, ...], groups: Sequence[tuple[str, ...]]) -> str:
    """Names of a group that not all groups have; empty for a single group."""
    if len(groups) < 2:
        return ""
    common = set.intersection(*(set(g) for g in groups))
    return "_".join(name for name in group if name not in common)


def _words(group: tuple[str, ...]) -> frozenset[str]:
    return frozenset(w for name in group for w in re.split(r"[\W_]+", name.lower()) if w)


#: Names of arrays of text that name the points of another one.
LABELS = re.compile(
    r"labels?|(node|marker|point|body|column)_?names?|names?|markers?|points?|columns|keypoints"
)
_BRACKETED = re.compile(r"^(.*?)\s*[\[(]([^\[\]()]*)[\])]\s*$")
_BETWEEN = re.compile(r"[\s,;]+")

#: Texts by the path of their array within a file.
Words = Mapping[tuple[str, ...], Sequence[str]]


def of_points(words: Words, tree: Tree) -> Words:
    """The texts without names of recordings: a `name`, or one word as `label`, beside times."""
    recordings = {key[:-1] for key in times_in(tree)}

    def names_recording(key: tuple[str, ...], texts: Sequence[str]) -> bool:
        if len(texts) != 1 or key[:-1] not in recordings:
            return False
        own = key[-1].lower()
        return own == "name" or (own == "label" and len(_BETWEEN.split(texts[0])) == 1)

    return {key: texts for key, texts in words.items() if not names_recording(key, texts)}


def labels(
    key: tuple[str, ...], shape: Sequence[int], words: Words, others: Collection[Sequence[int]]
) -> Sequence[str] | None:
    """Names of an array's points or columns, by texts in its group; None = there are none.

    others  shapes of the arrays of the group
    """
    texts = {k[-1]: names for k, names in words.items() if k[:-1] == key[:-1]}
    if (described := _names_in_sentence(key[-1], shape, texts)) is not None:
        return described
    for name, names in texts.items():
        if not LABELS.fullmatch(name.lower()):
            continue
        if len(names) == 1 and len(shape) > 1 and (several := _names_in_text(names[0], shape[1])):
            return several
        elsewhere = any(len(other) == 3 and len(names) in other for other in others)
        if len(names) in shape and len(shape) == 2 and not _fits(key[-1], names, elsewhere):
            continue
        if len(names) in shape or (len(names) == 1 and len(shape) > 1):
            return names
    return None


def _fits(name: str, names: Sequence[str], elsewhere: bool) -> bool:
    """Whether names are those of the columns of a matrix.

    Names of points are, where the matrix has a coordinate of each, or tells whether it is seen; or
    where no array of places is theirs, unless the columns are those of a quaternion.

    elsewhere  whether an array of places has as many points
    """
    meanings = [meaning(CapturedColumn(n)) for n in names]
    own = meaning(CapturedColumn(name))
    of_columns = any(m.axis or m.kind is not ColumnKind.OTHER for m in meanings)
    is_rotation = own.kind in (ColumnKind.QUATERNION, ColumnKind.ANGLE) and len(names) == 4
    of_each = bool(own.axis) or visibility(CapturedColumn(f"{names[0]} {name}")) is not None
    return of_columns or of_each or not (elsewhere or is_rotation)


def _names_in_text(text: str, count: int) -> list[str] | None:
    """So many names in one text, with their units: `x y pitch [m m rad]`, `x, y [mm]`."""
    if count < 2:
        return None
    units: list[str] = []
    if bracketed := _BRACKETED.match(text):
        units = [unit_of(word) for word in _BETWEEN.split(bracketed[2]) if word]
    known = bool(units) and all(units) and len(units) in (1, count)
    bare = bracketed[1] if bracketed and known else text
    names = [word for word in _BETWEEN.split(bare) if word]
    if len(names) != count:
        return None
    units = units * count if len(units) == 1 else units
    return [f"{n} [{u}]" for n, u in zip(names, units, strict=True)] if known else names


def _names_in_sentence(
    name: str, shape: Sequence[int], texts: Mapping[str, Sequence[str]]
) -> list[str] | None:
    """Names of columns in a sentence such as `grip = [x y theta], theta in deg`."""
    listed = re.compile(rf"(?<!\w){re.escape(name)}\s*[:=]\s*[\[({{]([^\])}}]*)[\])}}]")
    for text_values in texts.values():
        text = text_values[0] if len(text_values) == 1 else ""
        if len(shape) != 2 or not (match := listed.search(text)):
            continue
        names = [word for word in _BETWEEN.split(match[1]) if word]
        if len(names) != shape[1]:
            continue
        of_each = {n: re.search(rf"(?<!\w){re.escape(n)}\s+in\s+([^\s,;.]+)", text) for n in names}
        units = {n: unit_of(unit_match[1]) for n, unit_match in of_each.items() if unit_match}
        return [f"{n} [{units[n]}]" if units.get(n) else n for n in names]
    return None


#: Dimensions of places of several points in several trials: trial, time, point, axis.
_STACKED = 4


def with_trials_first(values: NDArray[Any], dimensions: Sequence[str]) -> NDArray[Any]:
    """An array with the dimension that is named after trials in front.

    dimensions  names of its dimensions; empty = it has none
    """
    named = [i for i, name in enumerate(dimensions) if names_trials(name)]
    return np.moveaxis(values, named[0], 0) if named else values


def by_trials(
    tree: Tree, units: dict[tuple[str, ...], str]
) -> tuple[Tree, dict[tuple[str, ...], str]]:
    """The arrays of a group with a dimension of trials in a group for each trial; and the units.

    Arrays without this dimension, such as a common time, are in each.
    """
    split, split_units = Tree(), dict[tuple[str, ...], str]()
    for group in dict.fromkeys(key[:-1] for key in tree):
        arrays = {key[-1]: values for key, values in tree.items() if key[:-1] == group}
        trials = _labels(arrays)
        for label, number in trials or [("", 0)]:
            for name, values in arrays.items():
                key = (*group, *((label,) if trials else ()), name)
                is_stacked = bool(trials) and _is_stacked(name, values, arrays)
                split[key] = values[number] if is_stacked else values
                split_units[key] = units.get((*group, name), "")
    return split, split_units


def _labels(arrays: dict[str, NDArray[Any]]) -> list[tuple[str, int]]:
    """Labels of a group's trials, and their places; empty = it has no dimension of trials."""
    count = _count(arrays)
    if not any(_is_stacked(name, values, arrays) for name, values in arrays.items()):
        return []
    stated = next((v for n, v in arrays.items() if names_trials(n) and v.shape == (count,)), None)
    words = [] if stated is None else [str(v) for v in stated.tolist()]
    if len(set(words)) < count:
        words = [f"trial{number}" for number in range(1, count + 1)]
    return [(word, place) for place, word in enumerate(words)]


def _is_stacked(name: str, values: NDArray[Any], arrays: dict[str, NDArray[Any]]) -> bool:
    """Whether an array has the dimension of trials in front, then one of times."""
    lengths = _lengths(arrays)
    of_series = values.ndim >= 2 and bool(lengths & set(values.shape[1:]))
    return (
        values.dtype.kind in "fiub" and values.shape[:1] == (_count(arrays),)
        and (of_series or (values.ndim == 1 and names_trials(name)))
    )  # fmt: skip


def _count(arrays: dict[str, NDArray[Any]]) -> int:
    """Number of trials: of their labels, or the first dimension of places in four; 0 = none."""
    counts = [v.size for n, v in arrays.items() if v.ndim == 1 and names_trials(n)]
    counts += [v.shape[0] for v in arrays.values() if v.ndim == _STACKED]
    counts = [n for n in counts if 1 < n <= MAX_TRIALS]
    return counts[0] if counts and counts[0] not in _lengths(arrays) else 0


def _lengths(arrays: dict[str, NDArray[Any]]) -> set[int]:
    """Lengths of the series: of arrays that are named after time, else of places in four."""
    times = [v for n, v in arrays.items() if _is_time(n) and v.ndim >= 1]
    return {v.shape[-1] for v in times} or {
        v.shape[1] for v in arrays.values() if v.ndim == _STACKED
    }


def _is_time(name: str) -> bool:
    return meaning(CapturedColumn(name)).kind is ColumnKind.TIME
