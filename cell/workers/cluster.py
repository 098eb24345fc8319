"""Jobs done by the workers of a Dask cluster.

Its scheduler repeats the jobs of a lost worker on another one.  A worker whose code differs from
the client's is refused.
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

#: Longest wait for the answer of a scheduler, s.
_CONNECT_S = 10.0
#: Interval at which a wait checks whether the results are still wanted, s.
_POLL_S = 0.1
#: Jobs that are submitted per worker ahead of the oldest result.
_AHEAD = 4
#: Number of jobs between two releases of free memory: a recording is a megabyte, and the copies of
#: Dask's thread fragment the memory.
_RELEASE_EVERY = 16
#: Longest time without a worker, s: a nanny restarts a lost worker in some seconds.
_NO_WORKER_S = 60.0
#: Command that starts workers.
START = "OPENBLAS_NUM_THREADS=1 dask worker {address} --nthreads 1 --nworkers auto"


class Cluster:
    """An executor of a scheduler's workers, including those that join it later."""

    def __init__(self, client: Client, address: str) -> None:
        self._client = client
        self._address = address

    @property
    def workers(self) -> int:
        """Number of simultaneous jobs."""
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
            # as the result of a job it is computed again after the loss of its worker
            task = self._client.submit(_cached_function, pack(function), key=f"{run}-function")
        try:
            while True:
                check()
                for number, job in islice(
                    sent, max(0, _AHEAD * max(1, self.workers) - len(futures))
                ):
                    future = self._client.submit(
                        _run, task, pack(job), identity().code, key=f"{run}-{number}", pure=False
                    )
                    futures.append((number, future))
                if not futures:
                    return
                number, future = futures[0]
                result = self._result(number, future, check)
                futures.popleft()  # not before: it would not be cancelled with the others
                yield result
                if number % _RELEASE_EVERY == 0:
                    release_free_memory()
        finally:
            self._client.cancel([future for _, future in futures])
            task.release()

    def _result(
        self, number: int, future: Future[bytes], check: Callable[[], None]
    ) -> JobResult[Any]:
        """Wait for a job's result.  Raises WorkersError."""
        from distributed import KilledWorker

        self._wait(future, check)
        try:
            return result_of(number, future.result())
        except KilledWorker as error:
            cause = f"ended {error.allowed_failures + 1} workers; is there enough memory?"
            return JobResult(number, None, RuntimeError(cause))
        except WorkersError:
            raise
        except Exception as error:  # cancelled: the scheduler has ended
            raise WorkersError(
                f"--workers {self._address}: the scheduler is lost ({type(error).__name__}); "
                "start it, and run the command again"
            ) from error

    def _wait(self, future: Future[bytes], check: Callable[[], None]) -> None:
        """Wait for the end of a job, with or without error.  Raises WorkersError: no worker.

        Not by `result(timeout)`: an abandoned wait continues in Dask's thread, holds the result,
        and sometimes ends with neither a result nor an error.
        """
        ended = threading.Event()
        future.add_done_callback(lambda _: ended.set())
        no_worker_since_s = None
        while not ended.wait(_POLL_S):
            check()
            if self._client.nthreads():
                no_worker_since_s = None
            elif no_worker_since_s is None:
                no_worker_since_s = time.monotonic()
            elif time.monotonic() - no_worker_since_s > _NO_WORKER_S:
                raise WorkersError(_no_worker_message(self._address))


@contextmanager
def cluster(address: str, tell: Callable[[str], None] = lambda note: None) -> Iterator[Cluster]:
    """The executor of a scheduler's workers.

    address  tcp://host:port or tls://host:port
    tell     called with a message if results may differ in their last bits
    raises   WorkersError: the package is missing, no answer comes, or a worker is refused
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
        raise WorkersError(_no_worker_message(address))
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


def _refused(worker: str, answer: object) -> list[str]:
    """Reasons to refuse a worker."""
    if not isinstance(answer, WorkerIdentity):
        return [
            f"worker {worker} cannot run this program ({answer}); install the same version of "
            "cable-cell there"
        ]
    reasons = [
        f"worker {worker} has another {difference}; install the same version of both there"
        for difference in identity().differences(answer)
    ]
    if answer.blas != "1":
        reasons.append(
            f"worker {worker} has OPENBLAS_NUM_THREADS {answer.blas}; start it with "
            "OPENBLAS_NUM_THREADS=1, so that sums have the same last bits"
        )
    return reasons


def _no_worker_message(address: str) -> str:
    return (
        f"--workers {address}: the scheduler has no worker; start some: "
        f"{START.format(address=address)}"
    )


def _cached_function(function: bytes) -> bytes:
    return function


def _run(function: bytes, job: bytes, code: str) -> bytes:
    """In a worker: run a job of a client whose code has this hash."""
    own = identity()
    if own.code != code or own.blas != "1":  # it has joined since the client's check
        import distributed

        worker = distributed.get_worker().address
        cause = f"worker {worker} has another code {own.code}, or other threads; end it"
        return pack((None, WorkersError(cause)))
    with one_core():
        return done(function, job)
