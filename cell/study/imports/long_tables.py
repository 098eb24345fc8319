"""Tables of one point or one marker per row, converted to one row per time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from cell.cable.arrays import FloatArray
from cell.files.words import first_of
from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.column_names import ColumnKind, meaning, visibility
from cell.study.imports.contents import HAND, contents
from cell.study.imports.row_trials import (
    rows_of,
    stacked_rows,
    trial_column,
    trial_labels,
    with_first,
    with_words,
)
from cell.study.imports.tracks import along_cable

#: A table, and its text columns by name.
Labelled = tuple[Capture, dict[str, list[str]]]

#: Words in the names of integer columns that identify markers.
_MARKER_WORDS = frozenset(
    ("marker", "id", "point", "node", "label", "landmark", "index", "track", "tid", "trajectory",
     "particle", "counter")
)  # fmt: skip
#: Names of the value column of a melted table, whose coordinates are named in a text column.
_VALUES = frozenset(("value", "wert", "valeur", "valor", "varvalue"))
#: Names of text columns that hold a coordinate's name, which comes last in a label; and maximum
#: number of columns that identify the rows of one time.
_COORDINATE_LABELS = frozenset(("field", "axis", "coord", "coordinate", "variable", "quantity"))
_MAX_KEYS = 3
#: Maximum number of labels; a column with more values does not name points.
_MAX_LABELS = 300
#: Name of a column of integer seconds or nanoseconds.
_TIME_PART = re.compile(r"(.*?)[\s_./]*\b(?:(secs?|seconds)|(nsecs?|nanosecs?|nanoseconds))")
_SECOND_NS = 1e9


def pivoted(capture: Capture, labels: Mapping[str, Sequence[str]]) -> Capture:
    """Table with one row per time, if each row held a single marker; else unchanged.

    labels  text columns, by name
    raises  InputError: a marker has two rows at one time
    """
    capture = with_joined_times(capture)
    capture, labels = _with_trial_words(capture, labels)
    time = time_column(capture)
    if time is None:
        return _without_text(capture, list(labels))
    if (column := trial_column(capture)) is not None:
        return _trial_by_trial(capture, labels, column)
    t = capture.values[:, time]
    repeats = len(np.unique(t)) < len(t)
    if not repeats:
        return _without_text(capture, list(labels))
    texts = {n: w for n, w in labels.items()
             if 2 <= len(set(w)) <= min(_MAX_LABELS, len(w) - 1)}  # fmt: skip
    if not texts:
        capture, rows = along_cable(capture, time)
        labels = {n: [w[i] for i in rows] for n, w in labels.items()}
        t = capture.values[:, time]
    texts |= _marker_numbers(capture, time)
    keys = _key_columns(t, texts)
    if not keys:
        return _without_text(capture, list(labels))
    ids = frozenset(i for i, c in enumerate(capture.columns) if c.name in keys)
    capture = _without_text(capture, [n for n in labels if n not in keys])
    values = [i for i, c in enumerate(capture.columns) if _is_value(c.name)]
    if any(meaning(c).kind is ColumnKind.COORDINATE for c in capture.columns):
        values = []  # the coordinates have columns of their own
    if values:
        capture = _without_invalid(capture, values[0])
    skipped = ids | {time} if not values else frozenset(range(len(capture.columns))) - {values[0]}
    keys.sort(key=lambda n: bool(_COORDINATE_LABELS & set(n.lower().split("_"))))
    prefix = [w[0] for w in labels.values() if len(set(w)) == 1 and w[0].lower() in HAND]
    words = [" ".join([*prefix, *p]) for p in zip(*(texts[n] for n in keys), strict=True)]
    return _wide(capture, time, words, skipped)


def _without_invalid(capture: Capture, value: int) -> Capture:
    """A melted table with nan for the values that a column says are not valid."""
    result = capture.values.copy()
    for index, column in enumerate(capture.columns):
        shown = visibility(CapturedColumn(f"value {column.name}"))
        if shown is not None:
            result[capture.values[:, index] < shown[1], value] = np.nan
    return replace(capture, values=result)


def _with_trial_words(
    capture: Capture, labels: Mapping[str, Sequence[str]]
) -> tuple[Capture, dict[str, Sequence[str]]]:
    """The table with the text column that identifies trials, and the other text columns."""
    remaining = dict(labels)
    for name, words in labels.items():
        extended = with_words(capture, name, words)
        if trial_column(extended) == name:
            return extended, {n: w for n, w in remaining.items() if n != name}
    return capture, remaining


def _trial_by_trial(capture: Capture, labels: Mapping[str, Sequence[str]], column: str) -> Capture:
    """Pivot the rows of each trial by itself; stack the results, with the trials' column.

    raises  InputError: a marker has two rows at one time of a trial
    """
    trials, parts = capture.column(column), list[Capture]()
    place = capture.names.index(column)
    for value, label in zip(np.unique(trials), trial_labels(capture, column), strict=True):
        rows = np.flatnonzero(trials == value)
        words = {name: [texts[i] for i in rows.tolist()] for name, texts in labels.items()}
        part = pivoted(rows_of(capture, {column: label}), words)
        same = np.full(len(part.values), value)
        parts.append(with_first(part, capture.columns[place], same))
    return stacked_rows(parts)


def names_points(name: str) -> bool:
    """Whether a column of integers identifies markers, by a word of its name."""
    return bool(_MARKER_WORDS.intersection(name.lower().replace("_", " ").split()))


def _marker_numbers(capture: Capture, time: int) -> dict[str, list[str]]:
    """Integer columns that identify markers, as labels."""
    numbers = {}
    for index, column in enumerate(capture.columns):
        ids = capture.values[:, index]
        integral = np.isfinite(ids).all() and np.all(ids == np.round(ids))
        if (
            names_points(column.name)
            and integral
            and index != time
            and 2 <= len(np.unique(ids)) <= _MAX_LABELS
        ):
            numbers[column.name] = [f"marker {int(i)}" for i in ids]
    return numbers


def _key_columns(t: FloatArray, texts: Mapping[str, Sequence[str]]) -> list[str]:
    """The fewest columns that, with the time, identify each row; else the first column."""
    for count in range(1, min(len(texts), _MAX_KEYS) + 1):
        for names in combinations(texts, count):
            rows = set(zip(t.tolist(), *(texts[n] for n in names), strict=True))
            if len(rows) == len(t):
                return list(names)
    return list(texts)[:1]


def one_row_per_time(capture: Capture) -> Capture:
    """Merge rows of one time that complement or repeat each other; unchanged if rows of one time
    contradict each other."""
    name = contents(capture).time
    if name is None or len(capture.values) < 2:
        return capture
    t = capture.column(name)
    is_first = np.append(True, np.diff(t) != 0.0)
    if is_first.all() or not np.isfinite(t).all() or np.any(np.diff(t) < 0.0):
        return capture
    first = np.flatnonzero(is_first)
    values = capture.values[first].copy()
    time_index = np.cumsum(is_first) - 1
    for row in np.flatnonzero(~is_first):
        merged, row_values = values[time_index[row]], capture.values[row]
        if np.any(np.isfinite(merged) & np.isfinite(row_values) & (merged != row_values)):
            return capture
        values[time_index[row]] = np.where(np.isfinite(merged), merged, row_values)
    count = len(t) - len(first)
    note = f"{capture.path}: {count} rows have the time of the row before, and nothing else in it"
    merged_rows = replace(capture, values=values, lines=capture.lines[first])
    return merged_rows.noted(f"{note}; they are joined to it")


def time_column(capture: Capture) -> int | None:
    """Index of the column that identifies rows of one time: times, else frame numbers."""
    kinds = [meaning(c) for c in capture.columns]
    for kind in (ColumnKind.TIME, ColumnKind.FRAME):
        places = [i for i, m in enumerate(kinds) if m.kind is kind]
        places.sort(key=lambda i: "header" not in kinds[i].group.split())  # stamped by its sensor
        if places:  # a constant is the start time of the recording
            varying = (i for i in places if len(np.unique(capture.values[:, i])) > 1)
            return next(varying, places[0])
    return None


def _without_text(capture: Capture, names: Sequence[str]) -> Capture:
    if not names:
        return capture
    listed = first_of([repr(name) for name in names], 8)
    note = f"{capture.path}: columns that hold words are not read: {listed}"
    return capture.noted(note)


def _wide(capture: Capture, time: int, words: Sequence[str], keys: frozenset[int]) -> Capture:
    """Table with one row per time, and columns named after marker and coordinate."""
    t = capture.values[:, time]
    names = list(dict.fromkeys(words))
    times, time_indices = np.unique(t, return_inverse=True)
    value_columns = [c for c in range(len(capture.columns)) if c not in keys]
    wide = np.full((len(times), len(names), len(value_columns)), np.nan)
    row_of_key: dict[tuple[int, int], int] = {}
    dups: list[int] = []
    for row, (time_index, word) in enumerate(zip(time_indices, words, strict=True)):
        key = int(time_index), names.index(word)
        if key in row_of_key and _is_duplicate(capture, row, row_of_key[key]):
            dups.append(row)
            continue
        if key in row_of_key:
            first = capture.lines[row_of_key[key]]
            raise capture.error(
                row, f"{word!r} is there twice at {t[row]:g}, first in line {first}; "
                "remove one, or give the two markers names of their own",
            )  # fmt: skip
        row_of_key[key] = row
        wide[key] = capture.values[row, value_columns]
    first = np.full(len(times), np.iinfo(np.intp).max, dtype=np.intp)
    np.minimum.at(first, time_indices, capture.lines)
    all_series = [
        (
            CapturedColumn(_name(word, capture.columns[c].name), capture.columns[c].unit),
            wide[:, i, k],
        )
        for i, word in enumerate(names)
        for k, c in enumerate(value_columns)
    ]
    nonempty = [(column, series) for column, series in all_series if np.isfinite(series).any()]
    notes = capture.notes
    if dups:
        note = f"{capture.path}:{capture.lines[dups[0]]}: {len(dups)} rows repeat another one of "
        notes = (*notes, f"{note}their time in all numbers; each counts once")
    return replace(
        capture,
        notes=notes,
        columns=(capture.columns[time], *(column for column, _ in nonempty)),
        values=np.column_stack([times, *(series for _, series in nonempty)]),
        lines=first,
    )


def _is_duplicate(capture: Capture, row: int, other: int) -> bool:
    """Whether two rows agree in all columns except times."""
    used = [i for i, c in enumerate(capture.columns) if meaning(c).kind is not ColumnKind.TIME]
    return np.array_equal(capture.values[row, used], capture.values[other, used], equal_nan=True)


def _name(word: str, column: str) -> str:
    """Label and column name; in a melted table the label alone, which names the coordinate."""
    return word if _is_value(column) else f"{word} {column}"


def _is_value(column: str) -> bool:
    return column.lower().strip("_") in _VALUES


def stacked(parts: Sequence[Labelled]) -> list[Labelled]:
    """Tables with their text columns; consecutive tables with equal columns are concatenated."""
    merged: list[Labelled] = []
    for part, labels in parts:
        if merged and labels:
            last, words = merged[-1]
            if last.columns == part.columns and list(words) == list(labels):
                combined = replace(
                    last,
                    values=np.vstack([last.values, part.values]),
                    lines=np.append(last.lines, part.lines),
                    notes=tuple(dict.fromkeys((*last.notes, *part.notes))),
                )
                merged[-1] = combined, {n: [*words[n], *labels[n]] for n in words}
                continue
        merged.append((part, labels))
    return merged


def of_frames(parts: Sequence[Labelled], numbers: Sequence[float]) -> Capture:
    """One row per time, of tables of a frame each: at its stated time, else by its number.

    raises  InputError: a table has other columns than the first, or a point is there twice
    """
    first, labels = parts[0]
    heads, times = [CapturedColumn("frame")], list(numbers)
    stated = dict.fromkeys(table.stated_time for table, _ in parts if table.stated_time)
    if any(meaning(c).kind is ColumnKind.TIME for c in first.columns):
        heads = []
    elif len(stated) == len(parts):
        heads, times = [CapturedColumn("time", next(iter(stated))[1])], [t for t, _ in stated]
    for table, words in parts:
        if (table.columns, *words) != (first.columns, *labels):
            message = f"has columns {', '.join((*words, *table.names))}; the first frame has "
            message += f"{', '.join((*labels, *first.names))}: give frames of one export"
            raise table.error(0, message)
    blocks = [np.column_stack([np.full((len(table.values), len(heads)), t), table.values])
              for (table, _), t in zip(parts, times, strict=True)]  # fmt: skip
    joint = replace(
        first,
        columns=(*heads, *first.columns),
        values=np.vstack(blocks),
        lines=np.concatenate([table.lines for table, _ in parts]),
    )
    labels = {name: [w for _, words in parts for w in words[name]] for name in labels}
    if not labels and not _marker_numbers(joint, 0):
        labels = {"point": [f"point {k + 1}" for b in blocks for k in range(len(b))]}
    return pivoted(joint, labels)


def _distinct_titles(
    tables: Sequence[Capture], titles: Mapping[int, str], default: str
) -> list[str]:
    """Titles of tables by the line number of their first row; numbers if they are not distinct."""
    words = [titles.get(int(t.lines[0]), "") for t in tables]
    distinct = all(words) and len(set(words)) == len(words)
    return words if distinct else [f"{default}{n}" for n in range(1, len(tables) + 1)]


def point_by_point(tables: Sequence[Capture], titles: Mapping[int, str]) -> Capture | None:
    """Join tables of one point each, with equal column names and times; None = they differ.

    The points are named as the tables; without different titles `marker 1`, and so on.

    titles  titles of the tables, by the line number of their first row
    """
    first = tables[0]
    if len(tables) < 2 or len(contents(first).points) != 1 or time_column(first) is None:
        return None
    if any(t.names != first.names or not same_frames(first, t) for t in tables):
        return None
    names = zip(_distinct_titles(tables, titles, "marker "), tables, strict=True)
    labels = [name for name, table in names for _ in table.values]
    return pivoted(stacked_rows(tables), {"point": labels})


def same_frames(first: Capture, second: Capture) -> bool:
    """Whether two tables have a row for each of the same frames or times."""
    first_time, second_time = time_column(first), time_column(second)
    if first_time is None or second_time is None:
        return False
    return np.array_equal(first.values[:, first_time], second.values[:, second_time])


def on_one_clock(table: Capture, gripper: Capture) -> Capture | None:
    """Merge the rows of a table and of a gripper's table with other times, sorted by time.

    None = the second holds no gripper, or the time columns differ.
    """
    times = [None if (i := time_column(t)) is None else t.columns[i] for t in (table, gripper)]
    trial, time = trial_column(table), times[0]
    shared = {name for name in table.names if name in gripper.names}
    if time is None or times[1] != time or shared != {time.name} | ({trial} - {None}):
        return None
    of_gripper, of_table = contents(gripper), contents(table)
    is_gripper = any(p.on_gripper for p in of_gripper.points) or of_gripper.angles
    spans = [(t.column(time.name).min(), t.column(time.name).max()) for t in (table, gripper)]
    disjoint = spans[0][1] < spans[1][0] or spans[1][1] < spans[0][0]
    has_own = any(p.on_gripper for p in of_table.points) or of_table.angles
    if not is_gripper or has_own or disjoint or of_table.counts or trial != trial_column(gripper):
        return None
    merged = stacked_rows([table, gripper])
    order = np.argsort(merged.column(time.name), kind="stable")
    if trial is not None:
        order = order[np.argsort(merged.column(trial)[order], kind="stable")]
    return replace(merged, values=merged.values[order], lines=merged.lines[order])


def trials_of_blocks(read: Sequence[Capture], titles: Mapping[int, str]) -> Capture | None:
    """Concatenate tables that are trials, with a column that identifies the trial.

    None = they are not trials.  Trials have equal columns, more than those of one point, and times
    that restart.

    titles  titles of the tables, by the line number of their first row
    """
    first, first_contents = read[0], contents(read[0])
    several = len(first_contents.points) > 1 or (first_contents.points and first_contents.angles)
    if len(read) < 2 or not several or first_contents.time is None or "trial" in first.names:
        return None
    if any(t.columns != first.columns for t in read):
        return None
    starts = [float(t.column(first_contents.time)[0]) for t in read]
    if any(t.column(first_contents.time)[-1] < max(starts) for t in read):
        return None
    words = _distinct_titles(read, titles, "")
    parts = [with_words(t, "trial", [w] * len(t.values)) for t, w in zip(read, words, strict=True)]
    trials = stacked_rows(parts)
    note = f"{first.path}: {len(read)} tables with the same columns are trials of their own"
    return trials.noted(note) if trial_column(trials) else None


def joined(table: Capture, extra: Capture) -> Capture:
    """A table with the columns of `extra` that it lacks, row by row."""
    new = extra.of_columns([i for i, n in enumerate(extra.names) if n not in table.names])
    return table.with_columns(new.columns, new.values).noted(*extra.notes)


def with_joined_times(capture: Capture) -> Capture:
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
    return replace(capture, columns=tuple(columns), values=values).of_columns(used)


def _stem_and_unit(column: CapturedColumn) -> tuple[str, str]:
    """Name of a column without its unit, and s or ns; else its name and its stated unit."""
    match = _TIME_PART.fullmatch(column.name.replace("_", " "))
    if match is not None and not column.unit:
        return match[1], "s" if match[2] else "ns"
    return column.name.replace("_", " "), column.unit


def _is_subsecond(part_ns: np.ndarray) -> bool:
    finite = part_ns[np.isfinite(part_ns)]
    return bool(len(finite) and np.all(finite >= 0.0) and np.all(finite < _SECOND_NS))
