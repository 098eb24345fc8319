"""Several trials in the rows of one file, told apart by a column such as `trial` or `run`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cell.study.imports.capture import Capture, CapturedColumn

#: Words for a trial, alone or beside a word for a number.
_TRIAL = frozenset(
    ("trial", "run", "swing", "take", "test", "rep", "repetition", "experiment", "recording",
     "versuch", "lauf", "messung", "essai", "prova", "ensayo", "prueba", "shot", "episode")
)  # fmt: skip
_NUMBER = frozenset(("id", "no", "nr", "num", "number", "index", "idx", "n"))
#: Trials of a file, at most, and rows of each, at least.
_MOST, _FEWEST_ROWS = 100, 10


#: A value of such a column, as `only` of a trial says it.
TrialLabel = float | str


def trial_column(capture: Capture) -> str | None:
    """The column of words or whole numbers that tells trials apart; None = there is none, or one
    trial."""
    for name, values in zip(capture.names, capture.values.T, strict=True):
        words = {w for w in re.split(r"[\W_]+", name.lower()) if w}
        if not words & _TRIAL or words - _TRIAL - _NUMBER or not np.isfinite(values).all():
            continue
        found, counts = np.unique(values, return_counts=True)
        whole = np.array_equal(found, np.round(found))
        if whole and 1 < len(found) <= _MOST and counts.min() >= _FEWEST_ROWS:
            return name
    return None


def trial_labels(capture: Capture, column: str) -> list[TrialLabel]:
    """Values of a column, each once: words in the order of their places, numbers rising."""
    found: list[float] = np.unique(capture.column(column)).tolist()
    words = capture.words(column)
    return [words[int(value)] for value in found] if words else list(found)


def with_words(capture: Capture, name: str, words: Sequence[str]) -> Capture:
    """The table with a first column of words, one a row."""
    each = list(dict.fromkeys(words))
    places = np.array([each.index(word) for word in words], dtype=np.float64)
    return replace(
        capture,
        columns=(CapturedColumn(name, words=tuple(each)), *capture.columns),
        values=np.column_stack([places, capture.values]),
    )


def rows_of(capture: Capture, only: Mapping[str, TrialLabel]) -> Capture:
    """Rows in which the columns that it has of some have these values, without these columns.

    raises  InputError: no row has them
    """
    there = {name: value for name, value in only.items() if name in capture.names}
    if not there:
        return capture
    rows = np.all([_has(capture, name, value) for name, value in there.items()], axis=0)
    if not rows.any():
        said = " and ".join(f"{name} {label_text(value)}" for name, value in there.items())
        raise capture.error(0, f"has no row with {said}; correct `only` of the trial")
    kept = [i for i, name in enumerate(capture.names) if name not in there]
    return replace(
        capture,
        columns=tuple(capture.columns[i] for i in kept),
        values=capture.values[np.ix_(np.flatnonzero(rows), np.array(kept))],
        lines=capture.lines[rows],
    )


def label_text(label: TrialLabel) -> str:
    """A value as text."""
    return label if isinstance(label, str) else f"{label:g}"


def _has(capture: Capture, name: str, label: TrialLabel) -> NDArray[np.bool_]:
    """(rows,) whether a column has a value."""
    words = [*capture.words(name), label] if capture.words(name) else []
    value = words.index(label) if words else label
    return np.asarray(capture.column(name) == value)


def stacked_rows(parts: Sequence[Capture]) -> Capture:
    """Rows of tables one below the other; columns of one name are one."""
    columns: dict[str, CapturedColumn] = {}
    for column in (c for part in parts for c in part.columns):
        known = columns.setdefault(column.name, column)
        words = tuple(dict.fromkeys((*known.words, *column.words)))
        columns[column.name] = replace(known, words=words)
    names, blocks = list(columns), []
    for part in parts:
        block = np.full((len(part.values), len(names)), np.nan)
        for column, values in zip(part.columns, part.values.T, strict=True):
            places = [columns[column.name].words.index(word) for word in column.words]
            block[:, names.index(column.name)] = (
                np.array(places)[values.astype(np.intp)] if places else values
            )
        blocks.append(block)
    return replace(
        parts[0],
        columns=tuple(columns.values()),
        values=np.vstack(blocks),
        lines=np.concatenate([part.lines for part in parts]),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )
