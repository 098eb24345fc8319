"""Tables with one row per time and marker, converted to one row per time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.column_names import ColumnKind, meaning

#: Names of a column of whole numbers that tell markers apart.
_NUMBERED = frozenset(("marker", "id", "point", "node", "label", "landmark", "index"))
#: Markers of a study, and a gripper's points; a column with more values is no name.
_MOST_LABELS = 300


def pivoted(capture: Capture, labels: Mapping[str, Sequence[str]]) -> Capture:
    """The table with one row per time, if each row has a single marker; else unchanged.

    labels  columns of text, by name
    raises  InputError: a marker is there twice at one time
    """
    time = time_column(capture)
    if time is None:
        return _without_text(capture, list(labels))
    t = capture.values[:, time]
    repeats = len(np.unique(t)) < len(t)
    for name, words in labels.items():
        if repeats and 2 <= len(set(words)) <= min(_MOST_LABELS, len(words) - 1):
            others = [n for n in labels if n != name]
            return _wide(_without_text(capture, others), time, words, frozenset((time,)))
    made = _without_text(capture, list(labels))
    if not repeats:
        return made
    for index, column in enumerate(made.columns):
        ids = made.values[:, index]
        named = _NUMBERED.intersection(column.name.lower().replace("_", " ").split())
        whole = np.isfinite(ids).all() and np.all(ids == np.round(ids))
        if named and whole and index != time and 2 <= len(np.unique(ids)) <= _MOST_LABELS:
            words = [f"marker {int(i)}" for i in ids]
            return _wide(made, time, words, frozenset((time, index)))
    return made


def time_column(capture: Capture) -> int | None:
    """Index of the column that identifies rows of one time: times, else frame numbers."""
    kinds = [meaning(c).kind for c in capture.columns]
    for kind in (ColumnKind.TIME, ColumnKind.FRAME):
        if kind in kinds:
            return kinds.index(kind)
    return None


def _without_text(capture: Capture, names: Sequence[str]) -> Capture:
    told = [f"{capture.path}: column {n!r} holds words; it is not read" for n in names]
    return replace(capture, notes=(*capture.notes, *told))


def _wide(capture: Capture, time: int, words: Sequence[str], keys: frozenset[int]) -> Capture:
    """Rows of one time beside each other, columns named after marker and coordinate."""
    t = capture.values[:, time]
    names = list(dict.fromkeys(words))
    times, places = np.unique(t, return_inverse=True)
    rest = [c for c in range(len(capture.columns)) if c not in keys]
    wide = np.full((len(times), len(names), len(rest)), np.nan)
    taken: dict[tuple[int, int], int] = {}
    for row, (place, word) in enumerate(zip(places, words, strict=True)):
        key = int(place), names.index(word)
        if key in taken:
            first = capture.lines[taken[key]]
            raise capture.error(
                row, f"{word!r} is there twice at {t[row]:g}, first in line {first}; "
                "remove one, or give the two markers names of their own",
            )  # fmt: skip
        taken[key] = row
        wide[key] = capture.values[row, rest]
    first = np.full(len(times), np.iinfo(np.intp).max, dtype=np.intp)
    np.minimum.at(first, places, capture.lines)
    made = [
        (
            CapturedColumn(_name(word, capture.columns[c].name), capture.columns[c].unit),
            wide[:, i, k],
        )
        for i, word in enumerate(names)
        for k, c in enumerate(rest)
    ]
    seen = [(column, series) for column, series in made if np.isfinite(series).any()]
    return replace(
        capture,
        columns=(capture.columns[time], *(column for column, _ in seen)),
        values=np.column_stack([times, *(series for _, series in seen)]),
        lines=first,
    )


def _name(word: str, column: str) -> str:
    """A melted table has its coordinate in the word: there a column `value` adds nothing."""
    return word if column.lower() in ("value", "wert", "valeur", "valor") else f"{word} {column}"
