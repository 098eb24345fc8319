"""Times that a file has in two columns: whole seconds, and nanoseconds beyond them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from cell.study.imports.capture import Capture, CapturedColumn

_AT_END = re.compile(r"(.*?)[\s_./]*\b(?:(secs?|seconds)|(nsecs?|nanosecs?|nanoseconds))")
_SECOND_NS = 1e9


def with_whole_times(capture: Capture) -> Capture:
    """The file with one column of seconds for each pair such as `stamp sec`, `stamp nanosec`."""
    said = [_said(column) for column in capture.columns]
    columns, values, dropped = list(capture.columns), capture.values.copy(), set[int]()
    for i, (stem, unit) in enumerate(said):
        k = said.index((stem, "ns")) if (stem, "ns") in said else None
        if unit != "s" or k is None or not _is_part(values[:, k]):
            continue
        name = stem if stem.endswith(("stamp", "time", "Time")) else f"{stem} time".strip()
        columns[i] = CapturedColumn(name, "s")
        values[:, i] += values[:, k] / _SECOND_NS
        dropped.add(k)
    kept = [i for i in range(len(columns)) if i not in dropped]
    return replace(capture, columns=tuple(columns[i] for i in kept), values=values[:, kept])


def _said(column: CapturedColumn) -> tuple[str, str]:
    """Name of a column without its unit, and s or ns; else its name and what unit is stated."""
    found = _AT_END.fullmatch(column.name.replace("_", " "))
    if found is not None and not column.unit:
        return found[1], "s" if found[2] else "ns"
    return column.name.replace("_", " "), column.unit


def _is_part(beyond_ns: np.ndarray) -> bool:
    seen = beyond_ns[np.isfinite(beyond_ns)]
    return bool(len(seen) and np.all(seen >= 0.0) and np.all(seen < _SECOND_NS))
