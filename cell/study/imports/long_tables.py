"""Tables of one point or one marker per row, converted to one row per time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.column_names import ColumnKind, meaning
from cell.study.imports.contents import HAND, contents
from cell.study.imports.row_trials import (
    rows_of,
    stacked_rows,
    trial_column,
    trial_labels,
    with_words,
)
from cell.study.imports.tracks import along_cable
from cell.study.imports.whole_times import with_whole_times

#: A table, and its columns of words by name.
Labelled = tuple[Capture, dict[str, list[str]]]

#: Names of a column of whole numbers that tell markers apart.
_NUMBERED = frozenset(
    ("marker", "id", "point", "node", "label", "landmark", "index", "track", "tid", "trajectory",
     "particle", "counter")
)  # fmt: skip
#: A melted table has one column of values, and its coordinate in a word.
_VALUES = frozenset(("value", "wert", "valeur", "valor"))
#: Columns of words that name coordinates, whose words are read last; and of all that tell rows of
#: one time apart.
_OF_COORDINATE = frozenset(("field", "axis", "coord", "coordinate", "variable", "quantity"))
_MOST_KEYS = 3
#: Markers of a study, and a gripper's points; a column with more values is no name.
_MOST_LABELS = 300


def pivoted(capture: Capture, labels: Mapping[str, Sequence[str]]) -> Capture:
    """The table with one row per time, if each row has a single marker; else unchanged.

    labels  columns of text, by name
    raises  InputError: a marker is there twice at one time
    """
    capture = with_whole_times(capture)
    time = time_column(capture)
    if time is None:
        return _without_text(capture, list(labels))
    capture, labels = _with_trial_words(capture, labels)
    if (column := trial_column(capture)) is not None:
        return _trial_by_trial(capture, labels, column)
    t = capture.values[:, time]
    repeats = len(np.unique(t)) < len(t)
    if not repeats:
        return _without_text(capture, list(labels))
    told = {n: w for n, w in labels.items() if _tells_apart(w)}
    if not told:
        capture, rows = along_cable(capture, time)
        labels = {n: [w[i] for i in rows] for n, w in labels.items()}
        t = capture.values[:, time]
    told |= _numbered(capture, time)
    chosen = _apart(t, told)
    if not chosen:
        return _without_text(capture, list(labels))
    ids = frozenset(i for i, c in enumerate(capture.columns) if c.name in chosen)
    capture = _without_text(capture, [n for n in labels if n not in chosen])
    values = [i for i, c in enumerate(capture.columns) if _is_value(c.name)]
    if any(meaning(c).kind is ColumnKind.COORDINATE for c in capture.columns):
        values = []  # the coordinates have columns of their own
    rest = ids | {time} if not values else frozenset(range(len(capture.columns))) - {values[0]}
    chosen.sort(key=lambda n: bool(_OF_COORDINATE & set(n.lower().split("_"))))
    of_hand = [w[0] for w in labels.values() if len(set(w)) == 1 and w[0].lower() in HAND]
    words = [" ".join([*of_hand, *p]) for p in zip(*(told[n] for n in chosen), strict=True)]
    return _wide(capture, time, words, rest)


def _with_trial_words(
    capture: Capture, labels: Mapping[str, Sequence[str]]
) -> tuple[Capture, dict[str, Sequence[str]]]:
    """The table with a column of words that tells trials apart among its columns."""
    rest = dict(labels)
    for name, words in labels.items():
        with_them = with_words(capture, name, words)
        if trial_column(with_them) == name:
            return with_them, {n: w for n, w in rest.items() if n != name}
    return capture, rest


def _trial_by_trial(capture: Capture, labels: Mapping[str, Sequence[str]], column: str) -> Capture:
    """The same of each trial in the rows, one below the other, with the column that tells them.

    raises  InputError: a marker is there twice at one time of a trial
    """
    told, parts = capture.column(column), list[Capture]()
    place = capture.names.index(column)
    for value, label in zip(np.unique(told), trial_labels(capture, column), strict=True):
        rows = np.flatnonzero(told == value)
        words = {name: [said[i] for i in rows.tolist()] for name, said in labels.items()}
        part = pivoted(rows_of(capture, {column: label}), words)
        parts.append(
            replace(
                part,
                columns=(capture.columns[place], *part.columns),
                values=np.column_stack([np.full(len(part.values), value), part.values]),
            )
        )
    return stacked_rows(parts)


def _tells_apart(words: Sequence[str]) -> bool:
    return 2 <= len(set(words)) <= min(_MOST_LABELS, len(words) - 1)


def _numbered(capture: Capture, time: int) -> dict[str, list[str]]:
    """Columns of whole numbers that tell markers apart, as words."""
    found = {}
    for index, column in enumerate(capture.columns):
        ids = capture.values[:, index]
        named = _NUMBERED.intersection(column.name.lower().replace("_", " ").split())
        whole = np.isfinite(ids).all() and np.all(ids == np.round(ids))
        if named and whole and index != time and 2 <= len(np.unique(ids)) <= _MOST_LABELS:
            found[column.name] = [f"marker {int(i)}" for i in ids]
    return found


def _apart(t: FloatArray, told: Mapping[str, Sequence[str]]) -> list[str]:
    """The first column that tells rows of one time apart; else as many as do so together, else the
    first."""
    for count in range(1, min(len(told), _MOST_KEYS) + 1):
        for names in combinations(told, count):
            rows = set(zip(t.tolist(), *(told[n] for n in names), strict=True))
            if len(rows) == len(t):
                return list(names)
    return list(told)[:1]


def one_row_per_time(capture: Capture) -> Capture:
    """The table with rows of one time that complement or repeat each other as one, if then each row
    has a time of its own; else unchanged."""
    name = contents(capture).time
    if name is None or len(capture.values) < 2:
        return capture
    t = capture.column(name)
    begins = np.append(True, np.diff(t) != 0.0)
    if begins.all() or not np.isfinite(t).all() or np.any(np.diff(t) < 0.0):
        return capture
    first = np.flatnonzero(begins)
    values = capture.values[first].copy()
    place = np.cumsum(begins) - 1
    for row in np.flatnonzero(~begins):
        there, new = values[place[row]], capture.values[row]
        if np.any(np.isfinite(there) & np.isfinite(new) & (there != new)):
            return capture
        values[place[row]] = np.where(np.isfinite(there), there, new)
    count = len(t) - len(first)
    note = f"{capture.path}: {count} rows have the time of the row before, and nothing else in it"
    return replace(
        capture,
        values=values,
        lines=capture.lines[first],
        notes=(*capture.notes, f"{note}; they are joined to it"),
    )


def time_column(capture: Capture) -> int | None:
    """Index of the column that identifies rows of one time: times, else frame numbers."""
    said = [meaning(c) for c in capture.columns]
    for kind in (ColumnKind.TIME, ColumnKind.FRAME):
        of_kind = [i for i, m in enumerate(said) if m.kind is kind]
        of_kind.sort(key=lambda i: "header" not in said[i].group.split())  # stamped by its sensor
        if of_kind:  # one value throughout is when a recording began
            moving = (i for i in of_kind if len(np.unique(capture.values[:, i])) > 1)
            return next(moving, of_kind[0])
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
    again: list[int] = []
    for row, (place, word) in enumerate(zip(places, words, strict=True)):
        key = int(place), names.index(word)
        if key in taken and _is_again(capture, row, taken[key]):
            again.append(row)
            continue
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
    notes = capture.notes
    if again:
        note = f"{capture.path}:{capture.lines[again[0]]}: {len(again)} rows repeat another one of "
        notes = (*notes, f"{note}their time in all numbers; each counts once")
    return replace(
        capture,
        notes=notes,
        columns=(capture.columns[time], *(column for column, _ in seen)),
        values=np.column_stack([times, *(series for _, series in seen)]),
        lines=first,
    )


def _is_again(capture: Capture, row: int, other: int) -> bool:
    """Whether two rows have the same numbers, whenever they were received."""
    kept = [i for i, c in enumerate(capture.columns) if meaning(c).kind is not ColumnKind.TIME]
    return np.array_equal(capture.values[row, kept], capture.values[other, kept], equal_nan=True)


def _name(word: str, column: str) -> str:
    """A melted table has its coordinate in the word: there a column `value` adds nothing."""
    return word if _is_value(column) else f"{word} {column}"


def _is_value(column: str) -> bool:
    return column.lower().strip("_") in _VALUES


def stacked(parts: Sequence[Labelled]) -> list[Labelled]:
    """Tables with their columns of words; those that go on with one another are one."""
    found: list[Labelled] = []
    for part, labels in parts:
        if found and labels:
            last, words = found[-1]
            if last.columns == part.columns and list(words) == list(labels):
                whole = replace(
                    last,
                    values=np.vstack([last.values, part.values]),
                    lines=np.append(last.lines, part.lines),
                    notes=tuple(dict.fromkeys((*last.notes, *part.notes))),
                )
                found[-1] = whole, {n: [*words[n], *labels[n]] for n in words}
                continue
        found.append((part, labels))
    return found


def point_by_point(read: Sequence[Capture]) -> Capture | None:
    """Tables of one point each under the same names and at the same times, side by side.

    None = they are not that; a point without a name is `marker 1` in the first table.
    """
    first, point = read[0], contents(read[0]).points
    time = time_column(first)
    if len(read) < 2 or len(point) != 1 or time is None:
        return None
    if any(t.names != first.names or not same_frames(first, t) for t in read):
        return None
    rest = [i for i in range(len(first.columns)) if i != time]
    columns = [
        CapturedColumn(f"marker {n} {first.columns[i].name}", first.columns[i].unit)
        for n in range(1, len(read) + 1)
        for i in rest
    ]
    values = [first.values[:, [time]], *(table.values[:, rest] for table in read)]
    notes = (note for table in read for note in table.notes)
    return replace(
        first,
        columns=(first.columns[time], *columns),
        values=np.hstack(values),
        notes=tuple(notes),
    )


def same_frames(one: Capture, other: Capture) -> bool:
    """Whether two tables have a row for each of the same frames or times."""
    first, second = time_column(one), time_column(other)
    if first is None or second is None:
        return False
    return np.array_equal(one.values[:, first], other.values[:, second])


def on_one_clock(one: Capture, other: Capture) -> Capture | None:
    """Rows of a table, and of one of the gripper at other times of the same column, by time.

    None = the other is not of a gripper, or they have not one clock.
    """
    times = [None if (i := time_column(t)) is None else t.columns[i] for t in (one, other)]
    trial, time = trial_column(one), times[0]
    shared = {name for name in one.names if name in other.names}
    if time is None or times[1] != time or shared != {time.name} | ({trial} - {None}):
        return None
    inside, of_first = contents(other), contents(one)
    of_gripper = any(p.on_gripper for p in inside.points) or inside.angles
    spans = [(t.column(time.name).min(), t.column(time.name).max()) for t in (one, other)]
    apart = spans[0][1] < spans[1][0] or spans[1][1] < spans[0][0]
    has_its_own = any(p.on_gripper for p in of_first.points) or of_first.angles
    if not of_gripper or has_its_own or apart or of_first.counts or trial != trial_column(other):
        return None
    whole = stacked_rows([one, other])
    order = np.argsort(whole.column(time.name), kind="stable")
    if trial is not None:
        order = order[np.argsort(whole.column(trial)[order], kind="stable")]
    return replace(whole, values=whole.values[order], lines=whole.lines[order])


def trials_of_blocks(read: Sequence[Capture], titles: Mapping[int, str]) -> Capture | None:
    """Tables that are trials one below the other, with a column that tells them apart.

    None = they are not trials: these have the same columns, several of them beside a point's, and
    times that begin again.

    titles  of the tables by the lines of their first rows
    """
    first, inside = read[0], contents(read[0])
    several = len(inside.points) > 1 or (inside.points and inside.angles)
    if len(read) < 2 or not several or inside.time is None or "trial" in first.names:
        return None
    if any(t.columns != first.columns for t in read):
        return None
    starts = [float(t.column(inside.time)[0]) for t in read]
    if any(t.column(inside.time)[-1] < max(starts) for t in read):
        return None
    words = [titles.get(int(t.lines[0]), "") for t in read]
    if len(set(words)) < len(words):
        words = [str(number) for number in range(1, len(read) + 1)]
    named = [with_words(t, "trial", [w] * len(t.values)) for t, w in zip(read, words, strict=True)]
    made = stacked_rows(named)
    note = f"{first.path}: {len(read)} tables with the same columns are trials of their own"
    return replace(made, notes=(*made.notes, note)) if trial_column(made) else None


def joined(one: Capture, other: Capture) -> Capture:
    """A table with the columns of another that it does not have, row by row."""
    new = [i for i, name in enumerate(other.names) if name not in one.names]
    return replace(
        one,
        columns=(*one.columns, *(other.columns[i] for i in new)),
        values=np.hstack([one.values, other.values[:, new]]),
        notes=(*one.notes, *other.notes),
    )
