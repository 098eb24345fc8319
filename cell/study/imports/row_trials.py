"""Several trials in the rows of one file, identified by a column such as `trial` or `run`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, CapturedColumn

#: Words for a trial, alone or with a word for a number.
_TRIAL = frozenset(
    ("trial", "run", "swing", "take", "test", "rep", "repetition", "experiment", "recording",
     "versuch", "lauf", "messung", "essai", "prova", "ensayo", "prueba", "shot", "episode")
)  # fmt: skip
_NUMBER = frozenset(("id", "no", "nr", "num", "number", "index", "idx", "n"))
#: Maximum number of trials of a file, and minimum number of rows of each.
MAX_TRIALS, _MIN_ROWS = 100, 10


#: A value of such a column, as in `only` of a trial's entry.
TrialLabel = float | str


def trial_column(capture: Capture) -> str | None:
    """Column of words or integers that identifies trials; None = no such column, or one trial."""
    for name, values in zip(capture.names, capture.values.T, strict=True):
        if not names_trials(name) or not np.isfinite(values).all():
            continue
        unique, counts = np.unique(values, return_counts=True)
        integral = np.array_equal(unique, np.round(unique))
        if integral and 1 < len(unique) <= MAX_TRIALS and counts.min() >= _MIN_ROWS:
            return name
    return None


def names_trials(name: str) -> bool:
    """Whether a name is a word for a trial, alone or with a word for a number."""
    words = {w for w in re.split(r"[\W_]+", name.lower()) if w}
    return bool(words & _TRIAL) and not words - _TRIAL - _NUMBER


def trial_labels(capture: Capture, column: str) -> list[TrialLabel]:
    """Distinct values of a column: words in order of their codes, numbers ascending."""
    numbers: list[float] = np.unique(capture.column(column)).tolist()
    words = capture.words(column)
    return [words[int(value)] for value in numbers] if words else list(numbers)


def with_words(capture: Capture, name: str, words: Sequence[str]) -> Capture:
    """Add a first column of words, one per row."""
    unique = list(dict.fromkeys(words))
    codes = np.array([unique.index(word) for word in words], dtype=np.float64)
    return with_first(capture, CapturedColumn(name, words=tuple(unique)), codes)


def with_first(capture: Capture, column: CapturedColumn, values: FloatArray) -> Capture:
    """Add a first column with its values (rows,)."""
    values = np.column_stack([values, capture.values])
    return replace(capture, columns=(column, *capture.columns), values=values)


def rows_of(capture: Capture, only: Mapping[str, TrialLabel]) -> Capture:
    """Select rows with these values, and drop their columns; columns that it lacks are ignored.

    raises  InputError: no row has them
    """
    criteria = {name: value for name, value in only.items() if name in capture.names}
    if not criteria:
        return capture
    rows = np.all([_matches(capture, name, value) for name, value in criteria.items()], axis=0)
    if not rows.any():
        text = " and ".join(f"{name} {label_text(value)}" for name, value in criteria.items())
        raise capture.error(0, f"has no row with {text}; correct `only` of the trial")
    others = [i for i, name in enumerate(capture.names) if name not in criteria]
    selected = replace(capture, values=capture.values[rows], lines=capture.lines[rows])
    return selected.of_columns(others)


def label_text(label: TrialLabel) -> str:
    """A value as text."""
    return label if isinstance(label, str) else f"{label:g}"


def _matches(capture: Capture, name: str, label: TrialLabel) -> NDArray[np.bool_]:
    words = [*capture.words(name), label] if capture.words(name) else []
    value = words.index(label) if words else label
    return np.asarray(capture.column(name) == value)


def stacked_rows(parts: Sequence[Capture]) -> Capture:
    """Concatenate rows of tables; columns of equal name are merged."""
    columns: dict[str, CapturedColumn] = {}
    for column in (c for part in parts for c in part.columns):
        merged = columns.setdefault(column.name, column)
        words = tuple(dict.fromkeys((*merged.words, *column.words)))
        columns[column.name] = replace(merged, words=words)
    names, blocks = list(columns), []
    for part in parts:
        block = np.full((len(part.values), len(names)), np.nan)
        for column, values in zip(part.columns, part.values.T, strict=True):
            codes = [columns[column.name].words.index(word) for word in column.words]
            block[:, names.index(column.name)] = (
                np.array(codes)[values.astype(np.intp)] if codes else values
            )
        blocks.append(block)
    return replace(
        parts[0],
        columns=tuple(columns.values()),
        values=np.vstack(blocks),
        lines=np.concatenate([part.lines for part in parts]),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )
