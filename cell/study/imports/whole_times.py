"""Combines times in two columns, integer seconds and nanoseconds, into one column."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from cell.study.imports.capture import Capture, CapturedColumn

_AT_END = re.compile(r"(.*?)[\s_./]*\b(?:(secs?|seconds)|(nsecs?|nanosecs?|nanoseconds))")
_SECOND_NS = 1e9


def with_whole_times(capture: Capture) -> Capture:
    """The file with one column of seconds for each pair such as `stamp sec`, `stamp nanosec`."""
    stems = [_stem_and_unit(column) for column in capture.columns]
    columns, values, dropped = list(capture.columns), capture.values.copy(), set[int]()
    for i, (stem, unit) in enumerate(stems):
        k = stems.index((stem, "ns")) if (stem, "ns") in stems else None
        if unit != "s" or k is None or not _is_subsecond(values[:, k]):
            continue
        name = stem if stem.endswith(("stamp", "time", "Time")) else f"{stem} time".strip()
        columns[i] = CapturedColumn(name, "s")
        values[:, i] += values[:, k] / _SECOND_NS
        dropped.add(k)
    used = [i for i in range(len(columns)) if i not in dropped]
    return replace(capture, columns=tuple(columns[i] for i in used), values=values[:, used])


def _stem_and_unit(column: CapturedColumn) -> tuple[str, str]:
    """Name of a column without its unit, and s or ns; else its name and its stated unit."""
    match = _AT_END.fullmatch(column.name.replace("_", " "))
    if match is not None and not column.unit:
        return match[1], "s" if match[2] else "ns"
    return column.name.replace("_", " "), column.unit


def _is_subsecond(part_ns: np.ndarray) -> bool:
    finite = part_ns[np.isfinite(part_ns)]
    return bool(len(finite) and np.all(finite >= 0.0) and np.all(finite < _SECOND_NS))
