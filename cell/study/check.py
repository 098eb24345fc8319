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

    row     of the markers at which it shows; None = in no row of its own
    column  of the file; empty = none
    table   another file of the trial that is wrong
    """

    values: Mapping[str, Any]
    row: int | None = None
    column: str = ""
    table: str = ""


@dataclass(frozen=True)
class DataCheck(Generic[EvidenceT]):
    """A question that is asked of measurements before any model is fitted.

    statistic  that answers it, with its unit; limit: beyond which the check fails
    outcome    the study is refused, or a note says so
    says       sentence with the names of the failure's values; its end joins the remedy
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
        """What is wrong, and the remedy."""
        return f"{self.says} {self.remedy}".rstrip().format_map(values)


Outcome = Literal["refused", "noted"]


def _check(
    outcome: Outcome, statistic: str, limit: str, says: str, remedy: str
) -> Callable[[Callable[[EvidenceT], Failure | None]], DataCheck[EvidenceT]]:
    def of(failure: Callable[[EvidenceT], Failure | None]) -> DataCheck[EvidenceT]:
        name, question = failure.__name__, failure.__doc__ or ""
        return DataCheck(name, question, statistic, limit, outcome, says, remedy, failure)

    return of


#: Decorators that make a check of a function.  Its name is the check's, its docstring the question;
#: the other entries are statistic, limit, sentence and remedy.
refused, noted = partial(_check, "refused"), partial(_check, "noted")


def failures(
    checks: Sequence[DataCheck[EvidenceT]], evidence: EvidenceT
) -> Iterator[tuple[Failure, str]]:
    """Yield the numbers and the sentence of every check that fails, in order."""
    for check in checks:
        found = check.failure(evidence)
        if found is not None:
            yield found, check.sentence(found.values)
