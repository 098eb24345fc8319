"""Checks of a model as table rows: question, test statistic, limit, and the verdict on failure.

Diagnosis and line have a table each; verdicts, text, pages, JSON and docs are made from the rows.
"""

from __future__ import annotations

import ast
import operator
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, Literal, Protocol, TypeVar

import numpy as np

from cell.cable.arrays import FloatArray
from cell.computer.watched import must_end
from cell.files.input_error import InputError
from cell.files.words import error_text
from cell.lab.data.results import CheckResult, Doubt, Verdict
from cell.study.data import Trial

#: Comparisons of a statistic with its limit.
COMPARE = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt}


class HasRules(Protocol):
    """Evidence about a model, with the limits that its checks use."""

    @property
    def rules(self) -> Any:
        """A dataclass of limits."""
        ...


EvidenceT = TypeVar("EvidenceT", bound=HasRules)


@dataclass(frozen=True)
class Reading:
    """The value of a check's test statistic.

    effects  that it concerns
    text     the same in words, where the number alone is not enough
    """

    value: float
    effects: tuple[str, ...] = ()
    text: str = ""


@dataclass(frozen=True)
class Check(Generic[EvidenceT]):
    """A check of a model: a test statistic, its limit, and the verdict if it fails.

    name       code in JSON, and of the warning if there is one
    unit       of the statistic: p (of noise alone), ln LR (ln of a likelihood ratio), …
    statistic  function of the evidence; None where the check does not apply
    passes     comparison of the statistic with the limit that holds if the check passes
    limit      field of the evidence's `rules`
    failing    verdict if it fails, unless another check makes it worse; or refusal of a candidate
    failed     sentence for a failure
    reason     the test by its name, or the measured quantity, and the reason for the limit
    warn       function for warnings with the study's numbers; or a text for each `{effect}`
    """

    name: str
    question: str
    unit: str
    statistic: Callable[[EvidenceT], Reading | None]
    passes: Literal["<=", ">=", "<", ">"]
    limit: str
    failing: Literal["unexplained", "cannot_tell", "refused"]
    failed: str
    reason: str
    warn: Callable[[EvidenceT, Reading], tuple[Doubt, ...]] | str = ""

    def evaluate(self, evidence: EvidenceT) -> CheckOutcome[EvidenceT]:
        """The outcome for a model."""
        reading, limit = self.statistic(evidence), float(getattr(evidence.rules, self.limit))
        passed = None if reading is None else bool(COMPARE[self.passes](reading.value, limit))
        return CheckOutcome(self, reading, passed, limit)


@dataclass(frozen=True)
class CheckOutcome(Generic[EvidenceT]):
    """The result of a check; `passed` is None where the check does not apply."""

    check: Check[EvidenceT]
    reading: Reading | None
    passed: bool | None
    limit: float = float("nan")

    def warnings(self, evidence: EvidenceT) -> tuple[Doubt, ...]:
        """Warnings with the numbers of the study, if it failed."""
        warn = self.check.warn
        if self.passed is not False or self.reading is None or not warn:
            return ()
        if isinstance(warn, str):
            return tuple(Doubt(self.name, warn.format(effect=e)) for e in self.reading.effects)
        return warn(evidence, self.reading)

    @property
    def name(self) -> str:
        """Name of the check."""
        return self.check.name

    @property
    def text(self) -> str:
        """The reading in words."""
        return "" if self.reading is None else self.reading.text

    @property
    def result(self) -> CheckResult:
        """The outcome as data."""
        check = self.check
        return CheckResult(
            name=check.name,
            question=check.question,
            unit=check.unit,
            statistic=None if self.reading is None else self.reading.value,
            passes=check.passes,
            limit=self.limit,
            passed=self.passed,
            failing=check.failing,
            failed=check.failed,
        )


def worst_verdict(outcomes: Sequence[CheckOutcome[Any]], is_base: bool) -> Verdict:
    """The worst verdict of the failed checks; if none failed, "complete" or "missing".

    "missing" has no p of its own: its effects were added by `cell.lab.search.effect_search`.

    is_base  nothing was added to the model
    """
    failed = {a.check.failing for a in outcomes if a.passed is False}
    if "unexplained" in failed:
        return "unexplained"
    if "cannot_tell" in failed:
        return "cannot_tell"
    return "complete" if is_base else "missing"


#: Largest size of a file with a statistic, bytes.
MAX_BYTES = 100_000


@dataclass(frozen=True, eq=False)
class Residual:
    """The residual of a model in one trial, after a fit to all trials.

    trial         gripper, markers as measured (T, markers, 2), m, and their times, s
    arc_length_m  (markers,) from the gripping point
    white         (T, markers, channels) residual in standard deviations, all trials jointly scaled
                  to rms 1; independent values if the model is complete; nan where not observed.
                  Channels are x and y, or one: the distance across a filmed cable
    """

    trial: Trial
    arc_length_m: FloatArray
    white: FloatArray


@dataclass(frozen=True)
class OwnCheck:
    """A user's own check: a question, and a test statistic of the residuals.

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
            line = _line_in(self.file, error) or self.line
            message = f"{error_text(error)}; mend that"
            raise InputError.at(self.file, message, line=line, key="statistic") from error
        if not np.isfinite(value):
            message = (
                f"gives {value}; give a number for every study, and mind nan where a marker was "
                "not seen (np.nanmean …)"
            )
            raise InputError.at(self.file, message, line=self.line, key="statistic")
        return value


def read_own_checks(paths: Sequence[Path | str], existing: Sequence[str] = ()) -> list[OwnCheck]:
    """Users' checks from Python files: docstring = question, `statistic(residuals)` = test.

    The files are programs, and are executed.
    existing  names of other checks
    raises    InputError: a file is no check, or its name is in use; FileNotFoundError
    """
    checks: list[OwnCheck] = []
    for path in paths:
        check = _read(Path(path))
        if check.name in (*existing, *(c.name for c in checks)):
            message = f"{check.name!r} is taken; rename the file"
            raise InputError.at(check.file, message, key="name")
        checks.append(check)
    return checks


def _read(path: Path) -> OwnCheck:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a Python file with a check")
    if path.suffix != ".py" or path.stat().st_size > MAX_BYTES:
        message = f"must be a Python file (.py) of up to {MAX_BYTES} bytes"
        raise InputError.at(path, message, key="file")
    try:
        source = path.read_text(encoding="utf-8")
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line, message = getattr(error, "lineno", None) or 1, f"is not Python: {error_text(error)}"
        raise InputError.at(path, f"{message}; mend that", line=line, key="file") from error
    question = (ast.get_docstring(tree) or "").strip().splitlines()
    defined = [n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == "statistic"]
    if not question or not question[0].endswith("?"):
        message = 'must ask a question; begin the file with """Is …?"""'
        raise InputError.at(path, message, key="docstring")
    if len(defined) != 1:
        message = "is missing; write a function `statistic(residuals)`"
        raise InputError.at(path, message, key="statistic")
    return _made(path.stem, question[0], path, defined[0].lineno, source)


def _made(name: str, question: str, path: Path, line: int, source: str) -> OwnCheck:
    """The check of a file with this source, which is run."""
    module = ModuleType(f"own_check_{path.stem}")
    module.__file__ = str(path)
    try:
        with must_end(f"{path}:1: its module"):
            exec(compile(source, str(path), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        message = f"{error_text(error)}; mend that"
        raise InputError.at(path, message, line=_line_in(path, error) or 1, key="file") from error
    return OwnCheck(name, question, path, line, module.statistic, source)


def _line_in(file: Path, error: BaseException) -> int | None:
    """The innermost line of a file in the traceback of an error."""
    frames = reversed(traceback.extract_tb(error.__traceback__))
    return next((f.lineno for f in frames if Path(f.filename) == file), None)
