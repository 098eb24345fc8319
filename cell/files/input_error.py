"""Errors in files that a person wrote: place, cause, remedy."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_UNITS = re.compile(r"_(?:m|mm|s|ms|hz|n|kg|rad|deg|px|[a-z]+_per_[a-z0-9_]+|fraction)$")


@dataclass(frozen=True)
class Problem:
    """One thing wrong with a file.  `line` and `column` count from 1; `key` is dotted or empty."""

    path: Path
    line: int
    column: int | None
    key: str
    message: str

    def __str__(self) -> str:
        place = f"{self.path}:{self.line}" + ("" if self.column is None else f":{self.column}")
        return f"{place}: " + (f"{self.key}: " if self.key else "") + self.message


class InputError(ValueError):
    """A file that a person wrote is wrong; `problems` says where, why and what to do."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(str(p) for p in problems))
        self.problems = tuple(problems)

    @classmethod
    def at(
        cls, path: Path, message: str, *, line: int = 1, column: int | None = None, key: str = ""
    ) -> InputError:
        """The error with one problem."""
        return cls([Problem(path, line, column, key, message)])


def did_you_mean(name: str, known: Sequence[str]) -> str:
    """'; did you mean …?', comparing names with and without their unit; else all known."""
    bare = {_UNITS.sub("", k): k for k in known}
    close = difflib.get_close_matches(name, known, 1, 0.6)
    if not close:
        close = [bare[b] for b in difflib.get_close_matches(_UNITS.sub("", name), bare, 1, 0.6)]
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; use one of those known here: {', '.join(known)}" if known else "; remove it"
