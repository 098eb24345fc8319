"""Jobs done by this process, or on this computer's cores."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager

from cell.cable.solver import one_core, threads
from cell.computer.forks import ProcessLostError, stream
from cell.computer.watched import MOST_FORKS
from cell.workers.executor import Executor, Job, JobResult, Returned
from cell.workers.shipping import done, know_own_effects, pack, result_of


class OneAfterAnother:
    """Executor that runs jobs one after another in this process; same results to the bit."""

    workers = 1

    def map(
        self,
        function: Callable[[Job], Returned],
        jobs: Iterable[Job],
        check: Callable[[], None] = lambda: None,
    ) -> Generator[JobResult[Returned]]:
        """See `Executor`."""
        know_own_effects()
        task = pack(function)
        for number, job in enumerate(jobs):
            check()
            with one_core():
                packed = done(task, pack(job))
            yield result_of(number, packed)


class LocalCores:
    """An executor that does as many jobs at a time as it has cores, in copies of this process.

    The copies end with this process, however it ends.
    """

    def __init__(self, cores: int) -> None:
        self.workers = min(cores, MOST_FORKS)

    def map(
        self,
        function: Callable[[Job], Returned],
        jobs: Iterable[Job],
        check: Callable[[], None] = lambda: None,
    ) -> Generator[JobResult[Returned]]:
        """See `Executor`."""
        know_own_effects()
        task = pack(function)

        def do(packed: bytes) -> bytes:
            with one_core():
                return done(task, packed)

        with closing(stream(do, (pack(job) for job in jobs), self.workers, check)) as results:
            for number, packed in enumerate(results):
                if isinstance(packed, ProcessLostError):
                    yield JobResult(number, None, packed)
                else:
                    yield result_of(number, packed)


def this_computer(cores: int | None = None) -> Executor:
    """The executor of this computer.

    cores  None = all that this process may use
    """
    if not sys.platform.startswith("linux"):  # only there a fork is a copy of this process
        return OneAfterAnother()
    return LocalCores(threads() if cores is None else cores)


@contextmanager
def executor(
    where: str | int | None = None, tell: Callable[[str], None] = lambda note: None
) -> Iterator[Executor]:
    """Executor of a cluster or of this computer's cores, within the `with`.

    where   address of a scheduler, number of cores of this computer; None = all of its cores
    tell    called with messages for a person about the workers
    raises  WorkersError
    """
    if isinstance(where, str):
        from cell.workers.cluster import cluster  # an extra, and a second to import

        with cluster(where, tell) as workers:
            yield workers
    else:
        yield this_computer(where)
