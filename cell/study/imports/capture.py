"""Content of one file: named columns of numbers, line numbers of the rows, stated metadata."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem, did_you_mean

Decimal = Literal[".", ","]

#: Words that programs write where nothing was seen.
NOT_SEEN = frozenset(
    ("", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", ".", "?", "missing", "lost")
)
_NUMBER = {
    ".": re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?"),
    ",": re.compile(r"[-+]?(?:\d+(?:,\d+)?|,\d+)(?:[eEdD][-+]?\d+)?"),
}
#: An error of a spreadsheet, in any of its languages, or of C: #N/A, #NV, #¡VALOR!, -1.#IND.
_SHEET_ERROR = re.compile(r"#[¡¿]?[^\W\d_][\w/]*[!?]?|[-+]?1\.#[A-Z]+0*")
_BLANKS = "'’\u00a0\u202f "
#: Groups of thousands: certainly, for it has both marks, blanks or two groups; and perhaps.
_GROUPED = {
    ".": re.compile(
        rf"[-+]?\d{{1,3}}(?:(?:,\d{{3}})+\.\d+|(?:,\d{{3}}){{2,}}|(?:[{_BLANKS}]\d{{3}})+(?:\.\d+)?)"
    ),
    ",": re.compile(
        rf"[-+]?\d{{1,3}}(?:(?:\.\d{{3}})+,\d+|(?:\.\d{{3}}){{2,}}|(?:[{_BLANKS}]\d{{3}})+(?:,\d+)?)"
    ),
}
_PERHAPS_GROUPED = {
    ".": re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d*)?"),
    ",": re.compile(r"[-+]?\d{1,3}(?:\.\d{3})+(?:,\d*)?"),
}
_MARKS = re.compile(rf"[.,{_BLANKS}]")
#: Hours, minutes, seconds and perhaps the half of the day, of which milliseconds may stand behind a
#: colon; or minutes and seconds, if these have a fraction.
_CLOCK = re.compile(
    r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+|:\d{3})?)(?: ?([AP])M)?|(\d{1,2}):(\d{2}[.,]\d+)",
    re.IGNORECASE,
)
#: A date and a time, as ISO 8601, databases and controllers (`DTL#`) write them; no date alone.
_MOMENT = re.compile(
    r"(?:[A-Z]{1,4}#)?(\d{4}-\d{2}-\d{2})[T _-](\d{2}:\d{2}:\d{2})(?:[.,](\d+))?"
    r" ?(Z|[-+]\d{2}(?::?\d{2})?)?"
)
#: The same as spreadsheets write it: day.month.year, or month/day/year.
_DATED = re.compile(
    r"(\d{1,2})([./])(\d{1,2})\2(\d{4}),? +"
    r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?(?: ?([AP])M)?",
    re.IGNORECASE,
)


def number(cell: str, decimal: Decimal, grouped: bool = False) -> float | None:
    """The number in a cell; nan where nothing was seen, None where something else stands.

    A date with a time becomes seconds since 1970, in UTC where no zone stands behind it; a time of
    day seconds since midnight.

    grouped  thousands are parted by the mark that is not the decimal one; else only a number that
             cannot be read otherwise is such
    """
    text = cell.strip().replace("−", "-")
    if _NUMBER[decimal].fullmatch(text):
        value = float(text.replace(",", ".").replace("d", "e").replace("D", "e"))
        return value if math.isfinite(value) else None
    if text.lower() in NOT_SEEN or _SHEET_ERROR.fullmatch(text):
        return math.nan
    if is_grouped(text, decimal) or (grouped and _PERHAPS_GROUPED[decimal].fullmatch(text)):
        whole, mark, part = text.partition(decimal)
        return float(_MARKS.sub("", whole) + ("." + part if mark else ""))
    if found := _CLOCK.fullmatch(text):
        hours, minutes, seconds = found.groups()[:3] if found[1] else ("0", found[5], found[6])
        whole = re.sub("[,:]", ".", seconds)
        return 3600.0 * _hour(hours, found[4]) + 60.0 * int(minutes) + float(whole)
    return _moment_s(text) if _MOMENT.fullmatch(text) else _dated_s(text)


def _hour(hours: str, half: str | None) -> int:
    """Of the day, where its half, A or P, may be given."""
    return int(hours) % 12 + 12 * (half.upper() == "P") if half else int(hours)


def is_grouped(text: str, decimal: Decimal) -> bool:
    """Whether a number certainly has groups of thousands."""
    return _GROUPED[decimal].fullmatch(text) is not None


def is_clock(cell: str) -> bool:
    """Whether a cell is a time of day, or a date with one, by its form."""
    text = cell.strip()
    return any(form.fullmatch(text) for form in (_CLOCK, _MOMENT, _DATED))


def is_number(cell: str, decimal: Decimal) -> bool:
    """Whether a cell holds a number, and not only a word for none."""
    value = number(cell, decimal)
    return value is not None and value == value


def _moment_s(text: str) -> float | None:
    """Seconds since 1970 of a date and a time; None = there is no such day or time."""
    day, time, part, zone = _MOMENT.fullmatch(text).groups()  # type: ignore[union-attr]
    try:
        whole = datetime.fromisoformat(f"{day}T{time}{zone or 'Z'}")
    except ValueError:
        return None
    return whole.timestamp() + float(f"0.{part or 0}")


def _dated_s(text: str) -> float | None:
    """Seconds since 1970 of a date and a time of a spreadsheet; None = it is none."""
    found = _DATED.fullmatch(text)
    if found is None:
        return None
    first, mark, second, year, hours, minutes, seconds, half = found.groups()
    month, day = (second, first) if mark == "." or int(first) > 12 else (first, second)
    try:
        hour = _hour(hours, half)
        whole = datetime(int(year), int(month), int(day), hour, int(minutes), tzinfo=UTC)
    except ValueError:
        return None
    return whole.timestamp() + float((seconds or "0").replace(",", "."))


class Sure(Enum):
    """Source of a proposed entry, and so how certain it is."""

    SAID = "said"
    """The file states it."""
    SEEN = "seen"
    """The data show it."""
    GUESSED = "guessed"
    """It is usual, or only indicated: somebody must check it."""
    WANTED = "wanted"
    """It cannot be known from the file: somebody must give it."""


@dataclass(frozen=True)
class Finding:
    """A sentence about one entry of the proposed mapping."""

    entry: str
    sentence: str
    sure: Sure

    def to_json(self) -> dict[str, str]:
        """Plain data."""
        return {"entry": self.entry, "sentence": self.sentence, "sure": self.sure.value}


class ImportFindings(list[Finding]):
    """What is found out as a mapping is proposed, in the order in which it is."""

    def said(self, entry: str, sentence: str) -> None:
        """Add what a file states about an entry."""
        self.append(Finding(entry, sentence, Sure.SAID))

    def seen(self, entry: str, sentence: str) -> None:
        """Add what the data show."""
        self.append(Finding(entry, sentence, Sure.SEEN))

    def guessed(self, entry: str, sentence: str) -> None:
        """Add what somebody must check."""
        self.append(Finding(entry, sentence, Sure.GUESSED))

    def wanted(self, entry: str, sentence: str) -> None:
        """Add what somebody must give."""
        self.append(Finding(entry, sentence, Sure.WANTED))


#: Stands for a column of time where a file has none.
ROW_NUMBER = "row number"


@dataclass(frozen=True)
class CapturedColumn:
    """Name of a column, and the unit that the file states for it; empty = none.

    words  of a column of words: its numbers are places in these, from 0; empty = it has numbers
    """

    name: str
    unit: str = ""
    words: tuple[str, ...] = ()


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
    pixel_m  length of a pixel, m, that the file states; None = it states none
    form     of a text; None = the file is no text
    notes    what was left out on reading, one sentence each
    of_cable  numbers that the file states of the cable, by their names in a study
    """

    path: Path
    columns: tuple[CapturedColumn, ...]
    values: FloatArray
    lines: NDArray[np.intp]
    rate_hz: float | None = None
    unit: str = ""
    form: TextForm | None = None
    notes: tuple[str, ...] = ()
    of_cable: tuple[tuple[str, float], ...] = ()
    counted: str = field(default="line", compare=False)
    pixel_m: float | None = None

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

    def words(self, name: str) -> tuple[str, ...]:
        """Those of a column of words; empty = the column has numbers, or is not there."""
        return next((c.words for c in self.columns if c.name == name), ())

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
