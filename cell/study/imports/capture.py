"""Content of one file: named columns of numbers, line numbers of the rows, stated metadata."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem, did_you_mean
from cell.study.entries import SectionPart

Decimal = Literal[".", ","]

#: Words that programs write for a missing value.
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
#: Thousands separators: certain (both marks, blanks or two groups), and possible.
_GROUPED = {
    ".": re.compile(
        rf"[-+]?\d{{1,3}}(?:(?:,\d{{3}})+\.\d+|(?:,\d{{3}}){{2,}}|(?:[{_BLANKS}]\d{{3}})+(?:\.\d+)?)"
    ),
    ",": re.compile(
        rf"[-+]?\d{{1,3}}(?:(?:\.\d{{3}})+,\d+|(?:\.\d{{3}}){{2,}}|(?:[{_BLANKS}]\d{{3}})+(?:,\d+)?)"
    ),
}
_POSSIBLY_GROUPED = {
    ".": re.compile(r"[-+]?\d{1,3}(?:,\d{3})+(?:\.\d*)?"),
    ",": re.compile(r"[-+]?\d{1,3}(?:\.\d{3})+(?:,\d*)?"),
}
_MARKS = re.compile(rf"[.,{_BLANKS}]")
#: Hours, minutes, seconds and an optional AM or PM; milliseconds may follow a colon.  Or minutes
#: and seconds, if these have a fraction.
_CLOCK = re.compile(
    r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+|:\d{3})?)(?: ?([AP])M)?|(\d{1,2}):(\d{2}[.,]\d+)",
    re.IGNORECASE,
)
#: A date and a time, as ISO 8601, databases and controllers (`DTL#`) write them; no date alone.
_ISO_DATETIME = re.compile(
    r"(?:[A-Z]{1,4}#)?(\d{4}-\d{2}-\d{2})[T _-](\d{2}:\d{2}:\d{2})(?:[.,](\d+))?"
    r" ?(Z|[-+]\d{2}(?::?\d{2})?)?"
)
#: A date and a time as spreadsheets write them: day.month.year, or month/day/year.
_SHEET_DATETIME = re.compile(
    r"(\d{1,2})([./])(\d{1,2})\2(\d{4}),? +"
    r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?(?: ?([AP])M)?",
    re.IGNORECASE,
)
#: A date whose month is a word, as MATLAB writes it, and that word in English, German and French.
_NAMED_MONTH = re.compile(r"(\d{1,2})-([^\W\d_]{3,5})\.?-(\d{4})(?=,? )")
_MONTHS = {word: month for month, words in enumerate(
    ("jan janv", "feb fév févr", "mar mär mrz mars", "apr avr", "may mai", "jun juin", "jul juil",
     "aug août", "sep sept", "oct okt", "nov", "dec dez déc"), 1) for word in words.split()
}  # fmt: skip


@lru_cache(maxsize=2**16)  # each pass over a table's cells asks again
def number(cell: str, decimal: Decimal, grouped: bool = False) -> float | None:
    """The number in a cell; nan if the value is missing, None if the cell holds anything else.

    A date with a time becomes seconds since 1970, in UTC without a time zone; a time of day becomes
    seconds since midnight.

    grouped  the mark that is not the decimal one separates thousands; else only in a number that
             cannot be read otherwise
    """
    text = cell.strip().replace("−", "-")
    if _NUMBER[decimal].fullmatch(text):
        value = float(text.replace(",", ".").replace("d", "e").replace("D", "e"))
        return value if math.isfinite(value) else None
    if text.lower() in NOT_SEEN or _SHEET_ERROR.fullmatch(text):
        return math.nan
    if is_grouped(text, decimal) or (grouped and _POSSIBLY_GROUPED[decimal].fullmatch(text)):
        digits, mark, fraction = text.partition(decimal)
        return float(_MARKS.sub("", digits) + ("." + fraction if mark else ""))
    if match := _CLOCK.fullmatch(text):
        hours, minutes, seconds = match.groups()[:3] if match[1] else ("0", match[5], match[6])
        digits = re.sub("[,:]", ".", seconds)
        return 3600.0 * _hour(hours, match[4]) + 60.0 * int(minutes) + float(digits)
    return _iso_datetime_s(text) if _ISO_DATETIME.fullmatch(text) else _sheet_datetime_s(text)


def _hour(hours: str, am_pm: str | None) -> int:
    """Hour of the day, with AM (A), PM (P) or neither."""
    return int(hours) % 12 + 12 * (am_pm.upper() == "P") if am_pm else int(hours)


def is_grouped(text: str, decimal: Decimal) -> bool:
    """Whether a number certainly has groups of thousands."""
    return _GROUPED[decimal].fullmatch(text) is not None


def is_clock(cell: str) -> bool:
    """Whether a cell is a time of day, or a date with one, by its form."""
    text = _with_number_of_month(cell.strip())
    return any(form.fullmatch(text) for form in (_CLOCK, _ISO_DATETIME, _SHEET_DATETIME))


def is_day_time(cell: str) -> bool:
    """Whether a cell is a time of day without a date, by its form."""
    return _CLOCK.fullmatch(cell.strip()) is not None


def is_number(cell: str, decimal: Decimal) -> bool:
    """Whether a cell holds a number, not a word for a missing value."""
    value = number(cell, decimal)
    return value is not None and value == value


def _iso_datetime_s(text: str) -> float | None:
    """Seconds since 1970 of a date and a time; None = there is no such day or time."""
    day, time, fraction, zone = _ISO_DATETIME.fullmatch(text).groups()  # type: ignore[union-attr]
    try:
        moment = datetime.fromisoformat(f"{day}T{time}{zone or 'Z'}")
    except ValueError:
        return None
    return moment.timestamp() + float(f"0.{fraction or 0}")


def _with_number_of_month(text: str) -> str:
    """A text in which a date such as 30-Nov-2026 is written 30.11.2026."""
    match = _NAMED_MONTH.match(text)
    month = None if match is None else _MONTHS.get(match[2].lower())
    return text if not match or not month else f"{match[1]}.{month}.{match[3]}{text[match.end() :]}"


def _sheet_datetime_s(text: str) -> float | None:
    """Seconds since 1970 of a date and a time of a spreadsheet or MATLAB; None = another form."""
    match = _SHEET_DATETIME.fullmatch(_with_number_of_month(text))
    if match is None:
        return None
    first, mark, second, year, hours, minutes, seconds, am_pm = match.groups()
    month, day = (second, first) if mark == "." or int(first) > 12 else (first, second)
    try:
        hour = _hour(hours, am_pm)
        moment = datetime(int(year), int(month), int(day), hour, int(minutes), tzinfo=UTC)
    except ValueError:
        return None
    return moment.timestamp() + float((seconds or "0").replace(",", "."))


class Sure(Enum):
    """Source of a proposed entry, and so how certain it is."""

    STATED = "stated"
    """The file states it."""
    SHOWN = "shown"
    """The data show it."""
    GUESSED = "guessed"
    """It is a default, or only indicated: the user must check it."""
    MISSING = "missing"
    """It cannot be determined from the file: the user must give it."""


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
    """Findings about a proposed mapping, in the order of their detection."""

    def stated(self, entry: str, sentence: str) -> None:
        """Add a finding that a file states about an entry."""
        self.append(Finding(entry, sentence, Sure.STATED))

    def shown(self, entry: str, sentence: str) -> None:
        """Add a finding that the data show."""
        self.append(Finding(entry, sentence, Sure.SHOWN))

    def guessed(self, entry: str, sentence: str) -> None:
        """Add a finding that the user must check."""
        self.append(Finding(entry, sentence, Sure.GUESSED))

    def missing(self, entry: str, sentence: str) -> None:
        """Add an entry that the user must give."""
        self.append(Finding(entry, sentence, Sure.MISSING))


#: Name of the column of times of a file that has none.
ROW_NUMBER = "row number"


@dataclass(frozen=True)
class CapturedColumn:
    """Name of a column, and the unit that the file states for it; empty = none.

    words     categories of a text column: its values are indices into them; empty = numeric column
    computed  whether it is computed from other columns of the file
    """

    name: str
    unit: str = ""
    words: tuple[str, ...] = ()
    computed: bool = False


class TextForm(SectionPart):
    """How a table is written as text: what separates its cells, and its decimal mark."""

    separator: Annotated[str, Field(min_length=1, max_length=1)]
    decimal: Decimal


@dataclass(frozen=True, eq=False)
class Capture:
    """One file, read.

    values   (rows, columns), nan = nothing there
    lines    (rows,) position of each row in the file, counted from 1 in units of `counted`
    rate_hz  rows a second that the file states; None = it states none
    unit     of length that the file states for all its columns; empty = none
    pixel_m  length of a pixel, m, that the file states; None = it states none
    stated_time  of all rows, by a remark above them, and its unit; None = there is none
    order    of rotations about axes, such as XYZ, that the file states; empty = it states none
    form     of a text; None = the file is no text
    notes    remarks on what was not read, one sentence each
    of_cable  properties of the cable that the file states, by their names in a study
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
    stated_time: tuple[float, str] | None = None
    order: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(c.name for c in self.columns)

    def column(self, name: str) -> FloatArray:
        """(rows,) values of a column; `row number` counts from 0 if no column has that name.

        raises  InputError: there is no such column
        """
        if name == ROW_NUMBER and name not in self.names:
            return np.arange(len(self.values), dtype=np.float64)
        if name not in self.names:
            raise self.error(0, f"has no column {name!r}{did_you_mean(name, self.names)}")
        return self.values[:, self.names.index(name)]

    def words(self, name: str) -> tuple[str, ...]:
        """Categories of a text column; empty = the column is numeric or missing."""
        return next((c.words for c in self.columns if c.name == name), ())

    def at(self, names: Sequence[str]) -> FloatArray:
        """(rows, names) values of several columns.  Raises InputError."""
        return np.stack([self.column(name) for name in names], axis=1)

    def noted(self, *notes: str) -> Capture:
        """The file with further notes."""
        return replace(self, notes=(*self.notes, *notes))

    def of_columns(self, indices: Sequence[int]) -> Capture:
        """The file with some of its columns."""
        columns = tuple(self.columns[i] for i in indices)
        return replace(self, columns=columns, values=self.values[:, list(indices)])

    def are_computed(self, names: Sequence[str]) -> bool:
        """Whether these columns are computed from others of the file."""
        return all(c.computed for c in self.columns if c.name in names)

    def with_columns(self, columns: Sequence[CapturedColumn], values: FloatArray) -> Capture:
        """The file with further columns, and their values (rows, columns)."""
        values = np.column_stack([self.values, values])
        return replace(self, columns=(*self.columns, *columns), values=values)

    def problem(self, row: int, message: str, key: str = "") -> Problem:
        """A problem of a row; if rows are not lines, the message has the row's number."""
        place = int(self.lines[row]) if len(self.lines) else 1
        if self.counted == "line":
            return Problem(self.path, place, None, key, message)
        return Problem(self.path, 1, None, key, f"{self.counted} {place}: {message}")

    def error(self, row: int, message: str, key: str = "") -> InputError:
        """An InputError with the problem of a row."""
        return InputError([self.problem(row, message, key)])
