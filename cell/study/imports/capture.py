"""What one file holds: named columns of numbers, the line of every row, what was said beside it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem, did_you_mean
from cell.study.imports.cells import Decimal

#: Stands for a column of time where a file has none.
ROW_NUMBER = "row number"


@dataclass(frozen=True)
class CapturedColumn:
    """Name of a column, and the unit that the file states for it; empty = none."""

    name: str
    unit: str = ""


@dataclass(frozen=True)
class TextForm:
    """How a table is written as text: what separates its cells, and its decimal mark."""

    separator: str
    decimal: Decimal


@dataclass(frozen=True, eq=False)
class Capture:
    """One file, read.

    values   (rows, columns), nan = nothing there
    lines    (rows,) where every row stands, counted from 1 in units of `counted`
    rate_hz  rows a second that the file states; None = it states none
    unit     of length that the file states for all its columns; empty = none
    form     of a text; None = the file is no text
    notes    what was left out on reading, one sentence each
    """

    path: Path
    columns: tuple[CapturedColumn, ...]
    values: FloatArray
    lines: NDArray[np.intp]
    rate_hz: float | None = None
    unit: str = ""
    form: TextForm | None = None
    notes: tuple[str, ...] = ()
    counted: str = field(default="line", compare=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(c.name for c in self.columns)

    def column(self, name: str) -> FloatArray:
        """(rows,) of a name; `row number` counts from 0 where no column is called so.

        raises  InputError: there is no such column
        """
        if name == ROW_NUMBER and name not in self.names:
            return np.arange(len(self.values), dtype=np.float64)
        if name not in self.names:
            raise self.error(0, f"has no column {name!r}{did_you_mean(name, self.names)}")
        return self.values[:, self.names.index(name)]

    def at(self, names: tuple[str, ...] | list[str]) -> FloatArray:
        """(rows, names) of several.  Raises InputError."""
        return np.stack([self.column(name) for name in names], axis=1)

    def problem(self, row: int, message: str, key: str = "") -> Problem:
        """A complaint about a row; where rows are no lines, the message says which it is."""
        place = int(self.lines[row]) if len(self.lines) else 1
        if self.counted == "line":
            return Problem(self.path, place, None, key, message)
        return Problem(self.path, 1, None, key, f"{self.counted} {place}: {message}")

    def error(self, row: int, message: str, key: str = "") -> InputError:
        """The same, to be raised."""
        return InputError([self.problem(row, message, key)])
