"""Cells of a table as numbers: decimal commas, words for what was not seen, times of day."""

from __future__ import annotations

import math
import re
from datetime import datetime
from typing import Literal

Decimal = Literal[".", ","]

#: Words that programs write where nothing was seen.
NOT_SEEN = frozenset(
    ("", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", ".", "?", "missing", "lost")
)
_NUMBER = {
    ".": re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?"),
    ",": re.compile(r"[-+]?(?:\d+(?:,\d+)?|,\d+)(?:[eEdD][-+]?\d+)?"),
}
_CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)")
#: A date and a time; a date alone is none.
_MOMENT = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2}(?:\.\d+)?(?:Z|[-+]\d{2}:?\d{2})?")


def number(cell: str, decimal: Decimal) -> float | None:
    """The number in a cell; nan where nothing was seen, None where something else stands.

    A date with a time becomes seconds since 1970, a time of day seconds since midnight.
    """
    text = cell.strip().replace("−", "-")
    if _NUMBER[decimal].fullmatch(text):
        value = float(text.replace(",", ".").replace("d", "e").replace("D", "e"))
        return value if math.isfinite(value) else None
    if text.lower() in NOT_SEEN:
        return math.nan
    if found := _CLOCK.fullmatch(text):
        hours, minutes, seconds = found.groups()
        return 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))
    return _moment(text) if _MOMENT.fullmatch(text) else None


def is_number(cell: str, decimal: Decimal) -> bool:
    """Whether a cell holds a number, and not only a word for none."""
    value = number(cell, decimal)
    return value is not None and value == value


def _moment(text: str) -> float | None:
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        return None
