"""Reads CSV tables of numbers with a header; every error names its line and column."""

from __future__ import annotations

import csv
import difflib
import reprlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError
from cell.files.text_file import read_text
from cell.files.words import counted

#: Limit beyond which a unit is assumed to be wrong, s.
MAX_TRIAL_S = 30.0
#: Limits: a minute at 1000 rows a second, and its size with 100 markers.
MAX_ROWS = 60_000
MAX_BYTES = 100_000_000


@dataclass(frozen=True)
class Table:
    """`values` (rows, columns), nan where a cell was empty; `lines` are line numbers from 1."""

    path: Path
    columns: tuple[str, ...]
    values: FloatArray
    lines: tuple[int, ...]

    def error(self, line: int, column: str | None, message: str) -> InputError:
        """A complaint about one place of the table, to be raised."""
        return InputError.at(self.path, message, line=line, key=column or "")

    def check(self, good: NDArray[np.bool_], complaint: Callable[[str], str]) -> None:
        """Raise InputError at the first cell that is not `good` (rows, columns)."""
        if not good.all():
            row, column = (int(i) for i in np.argwhere(~good)[0])
            name = self.columns[column]
            raise self.error(
                self.lines[row], name, f"{self.values[row, column]:g} {complaint(name)}"
            )


def read_table(path: Path, columns: Sequence[str], optional: Sequence[str] = ()) -> Table:
    """Read the named columns, in this order whatever their order in the file.

    Empty columns without a name, as a spreadsheet writes them, are skipped.

    optional  columns that may be missing, and are then not in the table
    raises  InputError: the file, a column or a cell is missing, unknown or not a number
    """
    text = read_text(path, MAX_BYTES)
    row_count = text.count("\n")
    if row_count > MAX_ROWS:
        message = (
            f"has {counted(row_count, 'row')}, limit {MAX_ROWS}; cut it to the motion and the "
            "swing after it, a few seconds, or leave out rows: 200 a second are plenty"
        )
        raise InputError.at(path, message, line=MAX_ROWS)
    reader = _cells(path, text)
    names = [name.strip() for name in next(reader, (1, []))[1]]
    header = [name for name in names if name]
    columns = _all_columns(path, header, columns, optional)
    rows: list[list[float]] = []
    lines: list[int] = []
    for line, cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        cells = _named_cells(path, line, cells, names)
        try:
            rows.append([float(cell) if cell.strip() else np.nan for cell in cells])
        except ValueError:
            bad = next(i for i, cell in enumerate(cells) if not _is_number(cell))
            message = f"{reprlib.repr(cells[bad])} is not a number; give one, or nan or nothing "
            message += "where nothing was seen"
            raise InputError.at(path, message, line=line, key=header[bad]) from None
        lines.append(line)
    values = np.array(rows, dtype=np.float64).reshape(len(rows), len(header))
    ordered = np.ascontiguousarray(values[:, [header.index(name) for name in columns]])
    table = Table(path, tuple(columns), ordered, tuple(lines))
    table.check(
        ~np.isinf(ordered), lambda _: "is not finite; give nan or nothing where nothing was seen"
    )
    return table


def _all_columns(
    path: Path, header: Sequence[str], columns: Sequence[str], optional: Sequence[str]
) -> list[str]:
    """The required columns, and the optional ones that exist.

    raises  InputError: one is missing, unknown or given twice
    """
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        raise InputError.at(path, "columns must be separated by commas, with decimal points")
    missing = [name for name in columns if name not in header]
    columns = [*columns, *(name for name in optional if name in header)]
    unknown = [name for name in header if name not in columns]
    if missing:
        close = difflib.get_close_matches(missing[0], unknown, 1, 0.5)
        hint = f"; is {close[0]!r} meant for it?" if close else ""
        message = f"column {missing[0]} is missing ({len(missing)} in all){hint}; needed: "
        raise InputError.at(path, f"{message}{_list_text(columns)}")
    if unknown:
        also = f"; possible: {_list_text(optional)}" if optional else ""
        message = f"unknown column; needed: {_list_text(columns)}{also}; remove it"
        raise InputError.at(path, message, key=unknown[0])
    if len(set(header)) < len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise InputError.at(path, "column given twice; remove one", key=twice)
    return columns


def _named_cells(path: Path, line: int, cells: Sequence[str], names: Sequence[str]) -> list[str]:
    """Cells of a line that have a name in the header.

    raises  InputError: there are too few, or a cell without a name is not empty
    """
    if any(cell.strip() for cell in cells[len(names) :]) or any(names[len(cells) :]):
        message = f"has {len(cells)} cells, the header has {len(names)}; give one for each name, "
        raise InputError.at(path, f"{message}1.5 and not 1,5 as a number", line=line)
    for i, (name, cell) in enumerate(zip(names, cells, strict=False)):
        if not name and cell.strip():
            message = f"has no name, yet {reprlib.repr(cell)} stands in it; empty it or name it"
            raise InputError.at(path, message, line=line, key=f"column {i + 1}")
    return [cell for name, cell in zip(names, cells, strict=False) if name]


def check_times(table: Table) -> None:
    """Raise InputError unless every row has its time, the last soon after the first."""
    t_s = table.values[:, 0]
    if len(t_s) < 2:
        raise table.error(1, None, f"has {counted(len(t_s), 'row')}, needs at least 2")
    if not np.isfinite(t_s).all():
        row = int(np.argmin(np.isfinite(t_s)))
        raise table.error(table.lines[row], "t_s", f"is {t_s[row]}; every row needs its time")
    step = np.diff(t_s)
    if (step <= 0.0).any():
        row = int(np.argmax(step <= 0.0)) + 1
        word = "repeats" if t_s[row] == t_s[row - 1] else "comes after"
        raise table.error(
            table.lines[row],
            "t_s",
            f"{t_s[row]:g} s {word} {t_s[row - 1]:g} s of the row before; "
            "sort the rows by time and keep one row per time",
        )
    if t_s[-1] - t_s[0] > MAX_TRIAL_S:
        raise table.error(
            table.lines[-1],
            "t_s",
            f"{t_s[-1]:g} s is {t_s[-1] - t_s[0]:g} s after the first row, limit "
            f"{MAX_TRIAL_S:g} s; give seconds, not milliseconds, and cut the record to the motion "
            "and the swing after it",
        )


def table_text(columns: Sequence[str], values: FloatArray) -> str:
    """CSV of `values` (rows, columns) that reads back to the last bit; nan = empty."""
    rows = (",".join("" if v != v else repr(v) for v in row) for row in values.tolist())
    return "\n".join([",".join(columns), *rows]) + "\n"


def _cells(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """Number of each line and its cells.  Raises InputError: a line is no CSV."""
    reader = csv.reader(text.splitlines())
    try:
        for cells in reader:
            yield reader.line_num, cells
    except csv.Error as error:
        message = f"is not CSV: {error}; write plain numbers between commas"
        raise InputError.at(path, message, line=reader.line_num) from error


def _list_text(columns: Sequence[str]) -> str:
    return ", ".join(columns) if len(columns) <= 6 else f"{', '.join(columns[:5])} … {columns[-1]}"


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return not cell.strip()
    return True
