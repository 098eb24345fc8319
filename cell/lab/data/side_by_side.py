"""Parts of a computation with a study, side by side on all cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from cell.cable.effects.base import Effect
from cell.cable.solver import threads
from cell.computer.forks import Forks, forks
from cell.lab.data.work import Work

Given = TypeVar("Given")
Returned = TypeVar("Returned")


class SideBySide:
    """Does jobs on all cores: the results, and the work counted, are those of one after the other.

    A job must not change what is looked at later: it may be done in a copy of this process.
    """

    def __init__(self, copies: Forks, work: Work, counted: dict[Any, Any]) -> None:
        self._copies = copies
        self._work = work
        self._counted = counted

    def map(
        self,
        function: Callable[[Given], Returned],
        jobs: Sequence[Given],
        done: Callable[[Given, Returned], None] = lambda job, result: None,
    ) -> list[Returned]:
        """Results of one of the functions, in the order of the jobs.

        done    is told of each as it comes, by any thread
        raises  StoppedError: no more simulations are wanted
        """
        before_s = self._work.simulated_s
        found = self._copies.map(
            self._counted[function],
            jobs,
            lambda job, result: done(job, result[0]),
            self._work.check,
        )
        self._work.simulated_s = before_s + sum(work_s for _, work_s in found)
        return [result for result, _ in found]


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
) -> Callable[[Given], tuple[Returned, float]]:
    """The function's result and the seconds of motion that it has simulated."""

    def counted(job: Given) -> tuple[Returned, float]:
        before_s, work.simulated_s = work.simulated_s, 0.0
        try:
            result = function(job)
            return result, work.simulated_s
        finally:
            work.simulated_s += before_s

    return counted
