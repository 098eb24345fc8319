"""A user's own check: a question and a statistic in a file, asked of what a model leaves."""

from __future__ import annotations

import ast
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from cell.cable.arrays import FloatArray
from cell.computer.watched import must_end
from cell.files.input_error import InputError, Problem
from cell.study.data import Trial

#: A statistic fits on a page.
MAX_BYTES = 100_000


@dataclass(frozen=True, eq=False)
class Residual:
    """What a model leaves of one trial, fitted to all trials.

    trial         hand, markers as measured (T, markers, 2), m, and their times, s
    arc_length_m  (markers,) from the gripping point
    white         (T, markers, channels) residual in standard deviations, all trials together scaled
                  to rms 1; independent values if the model is complete; nan where not seen.
                  Channels are x and y, or one: the distance across a filmed cable
    """

    trial: Trial
    arc_length_m: FloatArray
    white: FloatArray


@dataclass(frozen=True)
class OwnCheck:
    """A question of a user.

    name       of the file, without its ending
    question   first line of its docstring
    statistic  a number of the residuals of all trials: larger speaks against the model
    source     text of the file
    """

    name: str
    question: str
    file: Path
    line: int
    statistic: Callable[[Sequence[Residual]], Any]
    source: str = field(repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled with its source, so that another process has the same function."""
        return _made, (self.name, self.question, self.file, self.line, self.source)

    def of(self, residuals: Sequence[Residual]) -> float:
        """The statistic.  Raises InputError: it fails, or is no number."""
        try:
            with must_end(f"{self.file}:{self.line}: statistic"):
                value = float(self.statistic(residuals))
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            lines = [f.lineno for f in frames if Path(f.filename) == self.file]
            line = (lines[-1] if lines else None) or self.line
            message = f"{type(error).__name__}: {error}; mend that"
            raise InputError([Problem(self.file, line, None, "statistic", message)]) from error
        if not np.isfinite(value):
            message = (
                f"gives {value}; give a number for every study, and mind nan where a marker was "
                "not seen (np.nanmean …)"
            )
            raise InputError([Problem(self.file, self.line, None, "statistic", message)])
        return value


def read_own_checks(paths: Sequence[Path | str], taken: Sequence[str] = ()) -> list[OwnCheck]:
    """Checks from files, each with a docstring that asks and a function `statistic(residuals)`.

    The files are programs, and they are run.
    taken   names of checks that there are already
    raises  InputError: a file that is no check, or of a name that is taken; FileNotFoundError
    """
    found: list[OwnCheck] = []
    for path in paths:
        check = _read(Path(path))
        if check.name in (*taken, *(c.name for c in found)):
            _refuse(check.file, 1, "name", f"{check.name!r} is taken; rename the file")
        found.append(check)
    return found


def _read(path: Path) -> OwnCheck:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a Python file with a check")
    if path.suffix != ".py" or path.stat().st_size > MAX_BYTES:
        _refuse(path, 1, "file", f"must be a Python file (.py) of up to {MAX_BYTES} bytes")
    try:
        source = path.read_text(encoding="utf-8")
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = getattr(error, "lineno", None) or 1
        _refuse(path, line, "file", f"is not Python: {error}; mend that")
    question = (ast.get_docstring(tree) or "").strip().splitlines()
    defined = [n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == "statistic"]
    if not question or not question[0].endswith("?"):
        _refuse(path, 1, "docstring", 'must ask a question; begin the file with """Is …?"""')
    if len(defined) != 1:
        _refuse(path, 1, "statistic", "is missing; write a function `statistic(residuals)`")
    return _made(path.stem, question[0], path, defined[0].lineno, source)


def _made(name: str, question: str, path: Path, line: int, source: str) -> OwnCheck:
    """The check of a file with this source."""
    return OwnCheck(name, question, path, line, _run(path, source).statistic, source)


def _run(path: Path, source: str) -> Any:
    module = ModuleType(f"own_check_{path.stem}")
    module.__file__ = str(path)
    try:
        with must_end(f"{path}:1: its module"):
            exec(compile(source, str(path), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__)
                 if Path(f.filename) == path]  # fmt: skip
        line = (lines[-1] if lines else None) or 1
        _refuse(path, line, "file", f"{type(error).__name__}: {error}; mend that")
    return module


def _refuse(path: Path, line: int, key: str, message: str) -> None:
    raise InputError([Problem(path, line, None, key, message)])
