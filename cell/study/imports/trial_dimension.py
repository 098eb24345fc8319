"""Arrays with a dimension of trials, as xarray and MATLAB stack them: a group for each trial."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.study.imports.capture import CapturedColumn
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.groups import Tree
from cell.study.imports.row_trials import MAX_TRIALS, names_trials

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
