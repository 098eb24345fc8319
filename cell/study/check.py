"""A check of data as a row of a table: question, statistic, limit, sentence and remedy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Literal, TypeVar

EvidenceT = TypeVar("EvidenceT")


@dataclass(frozen=True)
class Failure:
    """The numbers of a check that fails, by their names in its sentence.

    row     of the markers where it shows; None = in no particular row
    column  of the file; empty = none
    table   another file of the trial that is wrong
    """

    values: Mapping[str, Any]
    row: int | None = None
    column: str = ""
    table: str = ""


@dataclass(frozen=True)
class DataCheck(Generic[EvidenceT]):
    """A check of measurements before any model is fitted, with a question as its text.

    statistic  tested statistic, with its unit; limit: the check fails beyond it
    outcome    the study is refused, or a note is added
    says       sentence with placeholders for the failure's values; the remedy is its end
    failure    function of the evidence: the numbers if the check fails, else None
    """

    name: str
    question: str
    statistic: str
    limit: str
    outcome: Literal["refused", "noted"]
    says: str
    remedy: str
    failure: Callable[[EvidenceT], Failure | None]

    def sentence(self, values: Mapping[str, Any]) -> str:
        """Sentence with the failure and the remedy."""
        return f"{self.says} {self.remedy}".rstrip().format_map(values)


Outcome = Literal["refused", "noted"]


def _check(
    outcome: Outcome, statistic: str, limit: str, says: str, remedy: str
) -> Callable[[Callable[[EvidenceT], Failure | None]], DataCheck[EvidenceT]]:
    def of(failure: Callable[[EvidenceT], Failure | None]) -> DataCheck[EvidenceT]:
        name, question = failure.__name__, failure.__doc__ or ""
        return DataCheck(name, question, statistic, limit, outcome, says, remedy, failure)

    return of


#: Decorators that make a check of a function, by its name and with its docstring as the question;
#: the arguments are statistic, limit, sentence and remedy.
refused, noted = partial(_check, "refused"), partial(_check, "noted")


def failures(
    checks: Sequence[DataCheck[EvidenceT]], evidence: EvidenceT
) -> Iterator[tuple[Failure, str]]:
    """Yield the numbers and the sentence of every check that fails, in order."""
    for check in checks:
        failure = check.failure(evidence)
        if failure is not None:
            yield failure, check.sentence(failure.values)
