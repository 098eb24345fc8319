"""Jobs done by the workers of a Dask cluster.

Its scheduler gives what a lost worker was doing to another.  Every worker runs the code that the
client runs, or is refused.
"""

from __future__ import annotations

import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from cell.cable.solver import one_core
from cell.computer.memory import release_free_memory, use_one_arena
from cell.workers.executor import Job, JobResult, Returned, WorkersError
from cell.workers.identity import WorkerIdentity, identity
from cell.workers.shipping import done, know_own_effects, pack, result_of
from drivers.installing import install_extra

if TYPE_CHECKING:
    from distributed import Client, Future

#: A scheduler on a network answers within it, s.
_CONNECT_S = 10.0
#: Whoever waits looks this often whether anybody still wants the results, s.
_LOOK_S = 0.1
#: Jobs that are given for each worker before the result of the oldest is taken.
_AHEAD = 4
#: A recording is a megabyte, and Dask's thread frees its copies among what it still uses: memory is
#: given back after so many jobs.
_RELEASED = 16
#: A worker that was lost is begun anew by its nanny in some seconds; with none for so long the
#: jobs wait for nobody, s.
_NOBODY_S = 60.0
#: How one is started.
START = "OPENBLAS_NUM_THREADS=1 dask worker {address} --nthreads 1 --nworkers auto"


class Cluster:
    """An executor of the workers that a scheduler has, also of those that join it later."""

    def __init__(self, client: Client, address: str) -> None:
        self._client = client
        self._address = address

    @property
    def workers(self) -> int:
        """Jobs that are done at a time."""
        return sum(self._client.nthreads().values())

    def map(
        self,
        function: Callable[[Job], Returned],
        jobs: Iterable[Job],
        check: Callable[[], None] = lambda: None,
    ) -> Generator[JobResult[Returned]]:
        """See `Executor`."""
        know_own_effects()
        run, sent = f"cell-{uuid4().hex}", iter(enumerate(jobs))
        futures: deque[tuple[int, Future[bytes]]] = deque()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sending large graph")  # it is sent once
            # as the result of a job it is made again where the worker that had it is lost
            task = self._client.submit(_cached_function, pack(function), key=f"{run}-function")
        try:
            while True:
                check()
                for number, job in islice(
                    sent, max(0, _AHEAD * max(1, self.workers) - len(futures))
                ):
                    future = self._client.submit(
                        _do, task, pack(job), identity().code, key=f"{run}-{number}", pure=False
                    )
                    futures.append((number, future))
                if not futures:
                    return
                number, future = futures[0]
                result = self._result(number, future, check)
                futures.popleft()  # until then it is under way, and is cancelled with the others
                yield result
                if number % _RELEASED == 0:
                    release_free_memory()
        finally:
            self._client.cancel([future for _, future in futures])
            task.release()

    def _result(
        self, number: int, future: Future[bytes], check: Callable[[], None]
    ) -> JobResult[Any]:
        """A job's result, once it is there.  Raises WorkersError."""
        from distributed import KilledWorker

        self._wait(future, check)
        try:
            return result_of(number, future.result())
        except KilledWorker as error:
            told = f"ended {error.allowed_failures + 1} workers; is there enough memory?"
            return JobResult(number, None, RuntimeError(told))
        except WorkersError:
            raise
        except Exception as error:  # cancelled: the scheduler has ended
            raise WorkersError(
                f"--workers {self._address}: the scheduler is lost ({type(error).__name__}); "
                "start it, and run the command again"
            ) from error

    def _wait(self, future: Future[bytes], check: Callable[[], None]) -> None:
        """Until a job has ended, in whatever way.  Raises WorkersError: nobody does it.

        Not by `result(timeout)`: a wait that is given up goes on in Dask's thread, holds what it
        waited for, and now and then ends with neither a result nor an error.
        """
        ended = threading.Event()
        future.add_done_callback(lambda _: ended.set())
        nobody_since_s = None
        while not ended.wait(_LOOK_S):
            check()
            if self._client.nthreads():
                nobody_since_s = None
            elif nobody_since_s is None:
                nobody_since_s = time.monotonic()
            elif time.monotonic() - nobody_since_s > _NOBODY_S:
                raise WorkersError(_nobody(self._address))


@contextmanager
def cluster(address: str, tell: Callable[[str], None] = lambda note: None) -> Iterator[Cluster]:
    """The executor of a scheduler's workers.

    address  tcp://host:port or tls://host:port
    tell     is told of what may make results differ in their last bits
    raises   WorkersError: the package is missing, nobody answers, or a worker may not be used
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise WorkersError(
            f"--workers {address}: the package `distributed` is missing; "
            f"install it: {install_extra('cluster')}"
        ) from error
    use_one_arena()  # of this process, as Dask's threads begin now
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise WorkersError(
            f"--workers {address}: no scheduler answers ({error}); start one with `dask scheduler`"
        ) from error
    try:
        _check(address, client, tell)
        yield Cluster(client, address)
    finally:
        client.close()


def _check(address: str, client: Client, tell: Callable[[str], None]) -> None:
    """Refuse workers that would give other results.  Raises WorkersError."""
    threads: Mapping[str, int] = client.nthreads()
    if not threads:
        raise WorkersError(_nobody(address))
    theirs = client.run(identity, on_error="return")
    refused = [line for worker in sorted(theirs) for line in _refused(worker, theirs[worker])]
    refused += [
        f"worker {worker} has {count} threads; start it with `--nthreads 1 --nworkers {count}`"
        for worker, count in sorted(threads.items())
        if count > 1
    ]
    if refused:
        raise WorkersError("\n".join(f"--workers {address}: {line}" for line in refused))
    for worker in sorted(theirs):
        if theirs[worker].processor != identity().processor:
            tell(
                f"worker {worker} has another processor ({theirs[worker].processor}): last bits of "
                "results may differ from those of this computer"
            )


def _refused(worker: str, said: object) -> list[str]:
    """Why a worker may not be used."""
    if not isinstance(said, WorkerIdentity):
        return [
            f"worker {worker} cannot run this program ({said}); install the same version of "
            "cable-cell there"
        ]
    found = [
        f"worker {worker} has another {difference}; install the same version of both there"
        for difference in identity().differences(said)
    ]
    if said.blas != "1":
        found.append(
            f"worker {worker} has OPENBLAS_NUM_THREADS {said.blas}; start it with "
            "OPENBLAS_NUM_THREADS=1, so that sums have the same last bits"
        )
    return found


def _nobody(address: str) -> str:
    return (
        f"--workers {address}: the scheduler has no worker; start some: "
        f"{START.format(address=address)}"
    )


def _cached_function(function: bytes) -> bytes:
    return function


def _do(function: bytes, job: bytes, code: str) -> bytes:
    """In a worker: a job of a client that has this code."""
    own = identity()
    if own.code != code or own.blas != "1":  # it has joined since the client looked
        import distributed

        worker = distributed.get_worker().address
        told = f"worker {worker} has another code {own.code}, or other threads; end it"
        return pack((None, WorkersError(told)))
    with one_core():
        return done(function, job)
