"""Several trials in the rows of one file, told apart by a column such as `trial` or `run`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cell.study.imports.capture import Capture

#: Words for a trial, alone or beside a word for a number.
_TRIAL = frozenset(
    ("trial", "run", "swing", "take", "test", "rep", "repetition", "experiment", "recording",
     "versuch", "lauf", "messung", "essai", "prova", "ensayo", "prueba", "shot", "episode")
)  # fmt: skip
_NUMBER = frozenset(("id", "no", "nr", "num", "number", "index", "idx", "n"))
#: Trials of a file, at most, and rows of each, at least.
_MOST, _FEWEST_ROWS = 100, 10


def trial_column(capture: Capture) -> str | None:
    """The column of whole numbers that tells trials apart; None = there is none, or one trial."""
    for name, values in zip(capture.names, capture.values.T, strict=True):
        words = {w for w in re.split(r"[\W_]+", name.lower()) if w}
        if not words & _TRIAL or words - _TRIAL - _NUMBER or not np.isfinite(values).all():
            continue
        found, counts = np.unique(values, return_counts=True)
        whole = np.array_equal(found, np.round(found))
        if whole and 1 < len(found) <= _MOST and counts.min() >= _FEWEST_ROWS:
            return name
    return None


def rows_of(capture: Capture, only: Mapping[str, float]) -> Capture:
    """Rows in which the columns that it has of some have these values, without these columns.

    raises  InputError: no row has them
    """
    there = {name: value for name, value in only.items() if name in capture.names}
    if not there:
        return capture
    rows = np.all([capture.column(name) == value for name, value in there.items()], axis=0)
    if not rows.any():
        said = " and ".join(f"{name} {value:g}" for name, value in there.items())
        raise capture.error(0, f"has no row with {said}; correct `only` of the trial")
    kept = [i for i, name in enumerate(capture.names) if name not in there]
    return replace(
        capture,
        columns=tuple(capture.columns[i] for i in kept),
        values=capture.values[np.ix_(np.flatnonzero(rows), np.array(kept))],
        lines=capture.lines[rows],
    )
