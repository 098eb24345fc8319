"""Interface of an executor of many independent jobs, here or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

Job = TypeVar("Job")
Returned = TypeVar("Returned")
Returned_co = TypeVar("Returned_co", covariant=True)


class WorkersError(ValueError):
    """Workers cannot be used.  Scenario: one of them has another version of this program."""


@dataclass(frozen=True)
class JobResult(Generic[Returned_co]):
    """The result of one job, or why there is none.

    number  of the job, from 0 in the order in which they were given
    error   what the job raised, or that it ends its process; None = it has a value
    """

    number: int
    _value: Returned_co | None = None
    error: Exception | None = None

    @property
    def value(self) -> Returned_co:
        """The result.  Raises what the job raised."""
        if self.error is not None:
            raise self.error
        return self._value  # type: ignore[return-value]  # None only where the job gives None


class Executor(Protocol):
    """Runs jobs; results do not depend on how many workers there are, nor where."""

    @property
    def workers(self) -> int:
        """Jobs that are done at a time."""
        ...

    def map(
        self,
        function: Callable[[Job], Returned],
        jobs: Iterable[Job],
        check: Callable[[], None] = lambda: None,
    ) -> Generator[JobResult[Returned]]:
        """Results in the order of the jobs, each as soon as it and those before it are there.

        Jobs are taken a few ahead of the results only.  An exception of a job is its result; the
        others are done.  What a worker was doing that is lost is done again by another.  Closing
        the iterator cancels what is under way.

        function  of one job alone: nothing that it changes is seen by another job or by the caller;
                  it, the jobs and the results can be pickled, effects of a user's files included
        check     may raise while a result is waited for
        raises    WorkersError: no worker is left, or one may not be used
        """
        ...


#: How the address of a scheduler begins.
SCHEMES = ("tcp://", "tls://")


def place(text: str) -> str | int:
    """Address of a scheduler, or a number of cores.  Raises WorkersError: it is neither."""
    if text.startswith(SCHEMES) and text.rpartition(":")[2].isdecimal():
        return text
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise WorkersError(
        f"--workers {text}: is neither a number of cores nor the address of a Dask scheduler; "
        "give 2, or tcp://host:8786"
    )
