"""Interface of an executor of many independent jobs, here or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

Job = TypeVar("Job")
Returned = TypeVar("Returned")
Returned_co = TypeVar("Returned_co", covariant=True)


class WorkersError(ValueError):
    """Workers cannot be used.  Scenario: a worker has a different version of this program."""


@dataclass(frozen=True)
class JobResult(Generic[Returned_co]):
    """The result of one job, or why there is none.

    number  of the job, from 0 in the order of submission
    error   raised by the job, or of the end of its process; None = it has a value
    """

    number: int
    _value: Returned_co | None = None
    error: Exception | None = None

    @property
    def value(self) -> Returned_co:
        """The result.  Raises the job's error."""
        if self.error is not None:
            raise self.error
        return self._value  # type: ignore[return-value]  # None only where the job gives None


class Executor(Protocol):
    """Runs jobs; results depend neither on the number of workers nor on their place."""

    @property
    def workers(self) -> int:
        """Number of simultaneous jobs."""
        ...

    def map(
        self,
        function: Callable[[Job], Returned],
        jobs: Iterable[Job],
        check: Callable[[], None] = lambda: None,
    ) -> Generator[JobResult[Returned]]:
        """Results in the order of the jobs, each as soon as all earlier ones are ready.

        Only a few jobs are taken ahead of the results.  An exception of a job is its result; the
        other jobs continue.  The jobs of a lost worker are repeated by another one.  Closing the
        iterator cancels running jobs.

        function  of one job alone: its side effects reach neither other jobs nor the caller; it,
                  the jobs and the results can be pickled, effects of a user's files included
        check     called during a wait for a result; may raise
        raises    WorkersError: no worker remains, or one is refused
        """
        ...


#: Schemes of a scheduler's address.
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
