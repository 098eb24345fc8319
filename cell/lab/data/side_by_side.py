"""Parts of a computation with a study, side by side on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from cell.cable.effects.base import Effect
from cell.cable.solver import threads
from cell.computer.compiling import computing_s
from cell.computer.forks import Forks, forks
from cell.lab.data.work import Budget, SpentError, Work

Given = TypeVar("Given")
Returned = TypeVar("Returned")

#: The work that is left is divided by the jobs, and by so many at least: few may be the first of
#: many.  A job may take so many parts of it: most take less than one.
FEWEST_PARTS, PARTS_OF_ONE = 4, 1.5


@dataclass(frozen=True)
class _Job(Generic[Given]):
    """What is given, and the work that it may take."""

    given: Given
    share: Budget


@dataclass(frozen=True)
class _Done(Generic[Returned]):
    """A result, none if its share of the work was spent before; work; process that did it."""

    result: Returned | None
    spent: bool
    work: Budget
    process: int


class SideBySide:
    """Does jobs on all cores: the results, and the work counted, are those of one after the other.

    A job must not change what is looked at later: it may be done in a copy of this process.  Each
    has the same share of the work that is left, whichever core does it.
    """

    def __init__(self, copies: Forks, work: Work, counted: dict[Any, Any]) -> None:
        self._copies = copies
        self._work = work
        self._counted = counted

    def map(
        self,
        function: Callable[[Given], Returned],
        jobs: Sequence[Given],
        unfinished: Callable[[Given], Returned],
        done: Callable[[Given, Returned], None] = lambda job, result: None,
    ) -> list[Returned]:
        """Results of one of the functions, in the order of the jobs.

        unfinished  the result of a job whose share of the work was spent
        done    is told of each as it comes, by any thread
        raises  StoppedError: no more simulations are wanted
        """
        work, here = self._work, os.getpid()
        before_s, parts = work.simulated_s, max(FEWEST_PARTS, len(jobs))
        share = work.limit.minus(work.done).share(PARTS_OF_ONE / parts)

        def result_of(job: _Job[Given], found: _Done[Returned]) -> Returned:
            return unfinished(job.given) if found.spent else found.result  # type: ignore[return-value]

        asked = [_Job(job, share) for job in jobs]
        found = self._copies.map(
            self._counted[function],
            asked,
            lambda job, result: done(job.given, result_of(job, result)),
            work.check,
        )
        work.simulated_s = before_s
        for one in found:
            work.add_forks(one.work.simulated_s, 0.0 if one.process == here else one.work.cpu_s)
        return [result_of(job, one) for job, one in zip(asked, found, strict=True)]


@contextmanager
def side_by_side(
    work: Work,
    functions: Sequence[Callable[[Any], Any]],
    effects: Iterable[type[Effect]],
    jobs: int,
) -> Iterator[SideBySide]:
    """All cores for some functions.

    effects  that what they take or give may have
    jobs     most that will be given at a time
    """
    counted = {function: _counted(function, work) for function in functions}
    most = min(jobs, threads())
    with forks(list(counted.values()), most=most, known=set(effects)) as copies:
        yield SideBySide(copies, work, counted)


def _counted(
    function: Callable[[Given], Returned], work: Work
) -> Callable[[_Job[Given]], _Done[Returned]]:
    """The function's result with the work that it has taken."""

    def counted(job: _Job[Given]) -> _Done[Returned]:
        before_s, began_s = work.simulated_s, computing_s()
        result, spent = None, False
        with work.part(job.share):
            try:
                result = function(job.given)
            except SpentError:
                spent = True
        took = Budget(work.simulated_s - before_s, computing_s() - began_s)
        return _Done(result, spent, took, os.getpid())

    return counted
