"""Text tables in which every channel has its own column of times."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cell.study.imports.capture import Capture, CapturedColumn, Decimal, is_number, number
from cell.study.imports.text_rows import split_line
from cell.study.imports.units import split_unit, unit_of

_SEPARATORS = ("\t", ";", ",")
#: Header lines that are searched for the channels' properties.
_MAX_HEADER = 60


def by_channels(path: Path, lines: Sequence[str]) -> Capture | None:
    """The table with one column of times and nan where a channel has no value; None = another form.

    In the header lines a property's name and its value alternate, once per channel.

    source  Beckhoff TwinCAT 3 Scope, export as CSV
    """
    for separator in _SEPARATORS:
        stated: dict[str, list[str]] = {}
        last = 0
        for i, line in enumerate(lines[:_MAX_HEADER]):
            cells = [cell.strip() for cell in split_line(line, separator)]
            names = set(cells[::2])
            if len(cells) > 3 and len(names) == 1 and (word := names.pop())[:1].isalpha():
                stated[word], last = cells[1::2], i
        properties = {split_unit(word)[0].lower(): (word, texts) for word, texts in stated.items()}
        if "name" in properties:
            rows = [split_line(line, separator) for line in lines[last + 1 :]]
            return _join(path, properties, rows, last + 2)
    return None


def _join(
    path: Path,
    properties: dict[str, tuple[str, list[str]]],
    rows: Sequence[Sequence[str]],
    first_line: int,
) -> Capture | None:
    """Columns of all channels at the union of their times."""
    names = properties["name"][1]
    _, units = properties.get("unit", ("", [""] * len(names)))
    mark: Decimal = "," if any("," in cell for row in rows[:_MAX_HEADER] for cell in row) else "."
    places = [i for i, row in enumerate(rows) if any(is_number(t, mark) for t in row[::2])]
    table = np.full((len(places), 2 * len(names)), np.nan)
    for k, i in enumerate(places):
        cells = [number(cell, mark) for cell in rows[i][: table.shape[1]]]
        table[k, : len(cells)] = [np.nan if value is None else value for value in cells]
    times, index = np.unique(table[:, ::2], return_inverse=True)
    count = int(np.isfinite(times).sum())
    values = np.full((len(times), len(names)), np.nan)
    lines = np.full(len(times), np.iinfo(np.intp).max, dtype=np.intp)
    for k, row in enumerate(index.reshape(-1, len(names)).T):
        values[row, k] = table[:, 2 * k + 1]
        np.minimum.at(lines, row, first_line + np.array(places, dtype=np.intp))
    if not count:
        return None
    unit = split_unit(properties.get("sampletime", ("", []))[0])[1]
    columns = [CapturedColumn("Time", unit)]
    stated_units = [unit_of(words.split()[0]) if words else "" for words in units]
    columns += [CapturedColumn(n, u) for n, u in zip(names, stated_units, strict=False)]
    return Capture(
        path,
        tuple(columns),
        np.column_stack([times, values])[:count],
        lines[:count],
        notes=(f"{path}: each channel has its own times; they are joined",),
    )
