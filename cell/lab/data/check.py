"""Checks as data: a question to a model, the number that answers it, its limit, what failing means.

Diagnosis and line have a table each; verdicts, text, pages, JSON and docs are made from the rows.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, TypeVar

from cell.lab.data.results import CheckResult, Doubt, Verdict

#: Comparisons of a statistic with its limit.
COMPARE = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt}


class HasRules(Protocol):
    """What is known of a model, and the limits that it is held against."""

    @property
    def rules(self) -> Any:
        """A dataclass of limits."""
        ...


EvidenceT = TypeVar("EvidenceT", bound=HasRules)


@dataclass(frozen=True)
class Reading:
    """The number that answers a question.

    effects  that it is about
    found    the same in words, where the number alone says too little
    """

    value: float
    effects: tuple[str, ...] = ()
    found: str = ""


def _none(evidence: Any, reading: Reading) -> tuple[Doubt, ...]:
    return ()


@dataclass(frozen=True)
class Check(Generic[EvidenceT]):
    """A question that is asked of a model before anything is claimed of it.

    name       code in JSON, and of the warning if there is one
    unit       of the statistic: p (of noise alone), ln LR (ln of a likelihood ratio), …
    statistic  the number that answers the question; None where it does not apply
    passes     how the statistic compares with the limit if all is well
    limit      field of the evidence's `rules`
    failing    what the verdict is then, unless another check makes it worse; or that a candidate
               is refused for the line
    failed     sentence that says so
    reason     how it is judged, and why so: a test by its name, or what was measured
    warn       warnings with the numbers of the study
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
    warn: Callable[[EvidenceT, Reading], tuple[Doubt, ...]] = _none

    def evaluate(self, evidence: EvidenceT) -> CheckOutcome[EvidenceT]:
        """Of a model."""
        reading, limit = self.statistic(evidence), float(getattr(evidence.rules, self.limit))
        passed = None if reading is None else bool(COMPARE[self.passes](reading.value, limit))
        return CheckOutcome(self, reading, passed, limit)


@dataclass(frozen=True)
class CheckOutcome(Generic[EvidenceT]):
    """A check's answer; `passed` is None where the question does not apply."""

    check: Check[EvidenceT]
    reading: Reading | None
    passed: bool | None
    limit: float = float("nan")

    def warnings(self, evidence: EvidenceT) -> tuple[Doubt, ...]:
        """With the numbers of the study, if it failed."""
        if self.passed is not False or self.reading is None:
            return ()
        return self.check.warn(evidence, self.reading)

    @property
    def name(self) -> str:
        """Of the check."""
        return self.check.name

    @property
    def found(self) -> str:
        """What was found, in words."""
        return "" if self.reading is None else self.reading.found

    @property
    def result(self) -> CheckResult:
        """As data."""
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


def worst_verdict(found: Sequence[CheckOutcome[Any]], is_base: bool) -> Verdict:
    """The worst of what failed; else that the model is complete, or an effect is missing.

    is_base  nothing was added to the model
    """
    failed = {a.check.failing for a in found if a.passed is False}
    if "unexplained" in failed:
        return "unexplained"
    if "cannot_tell" in failed:
        return "cannot_tell"
    return "complete" if is_base else "missing"
