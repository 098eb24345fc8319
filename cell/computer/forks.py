"""Runs jobs on all cores at once, in forks of this process, each with its own interpreter lock.

A fork starts with a copy of this process's memory, so a job needs only its arguments, and gives the
same result as here.  On other systems than Linux this process runs all jobs.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import io
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from functools import partial
from itertools import islice
from queue import SimpleQueue
from typing import Any, BinaryIO, TypeVar

from cell.computer.watched import MOST_FORKS, fork_ended, fork_started

Given = TypeVar("Given")
Returned = TypeVar("Returned")

#: Interval at which a wait for forks checks whether the results are still wanted, s.
_POLL_S = 0.05
_SIZE_BYTES = 8
#: Polling interval for the parent's end where the system does not signal it, s.
_PARENT_S = 1.0
#: Option of prctl: signal to a process when its parent has ended.
_PR_SET_PDEATHSIG = 1


#: Signals whose handlers are this process's alone.
_PARENTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class LostError(Exception):
    """A fork has ended, or could not do a job."""


class Forks:
    """This process and its forks, which run jobs in parallel; valid within `forks`."""

    def __init__(self, workers: Sequence[Fork]) -> None:
        self._workers = workers

    def map(
        self,
        function: Callable[[Given], Returned],
        jobs: Sequence[Given],
        done: Callable[[Given, Returned], None] = lambda job, result: None,
        check: Callable[[], None] = lambda: None,
    ) -> list[Returned]:
        """Results of all jobs, in their order; side effects of jobs in copies are lost.

        Each free core takes the next job.  A job that failed in a copy, because that was killed or
        the function raised, is done again by this process.

        function  one of the functions of `forks`
        done      called with every job as its result comes, by any thread
        check     may raise while others are waited for
        """
        waiting = deque(enumerate(jobs))
        results: dict[int, Returned] = {}
        stopped: list[BaseException] = []

        def work(do: Callable[[Given], Returned]) -> None:
            while not stopped:
                try:
                    number, job = waiting.popleft()
                except IndexError:
                    return
                try:
                    result = do(job)
                except LostError:
                    waiting.appendleft((number, job))
                    return
                done(job, result)
                results[number] = result

        def work_in(copy: Fork) -> None:
            try:
                work(partial(copy.do, function))
            except BaseException as error:  # of `done`
                stopped.append(error)

        others = [
            threading.Thread(target=work_in, args=(copy,), daemon=True)
            for copy in self._workers[: max(0, len(jobs) - 1)]
        ]
        for other in others:
            other.start()
        try:
            while len(results) < len(jobs):
                work(function)
                check()
                if stopped:
                    raise stopped[0]
                if busy := [other for other in others if other.is_alive()]:
                    busy[0].join(_POLL_S)
        except BaseException as error:
            stopped.append(error)
            self.close()
            raise
        finally:
            for other in others:
                other.join()
        return [results[number] for number in range(len(jobs))]

    def close(self) -> None:
        """Kill the copies."""
        for worker in self._workers:
            worker.end()


@contextmanager
def forks(
    functions: Sequence[Callable[[Any], Any]],
    *,
    most: int,
    known: Iterable[object] = (),
) -> Iterator[Forks]:
    """Fork this process within the `with`; the forks can call any of `functions`.

    most   largest number of simultaneous jobs, those of this process included
    known  objects that are not pickled: a copy has them, and its results refer to this process's
    """
    workers: list[Fork] = []
    try:
        for slot in range(min(most - 1, MOST_FORKS) if sys.platform == "linux" else 0):
            with contextlib.suppress(OSError):  # no memory, or no more processes for this user
                workers.append(Fork(slot, functions, list(known)))
        yield Forks(workers)
    finally:
        for worker in workers:
            worker.end()


class Fork:
    """A copy of this process that does one job at a time."""

    def __init__(
        self, slot: int, functions: Sequence[Callable[[Any], Any]], known: Sequence[object]
    ) -> None:
        self.slot = slot
        self._functions = functions
        self._known = known
        child_reads, here_writes = os.pipe()
        here_reads, child_writes = os.pipe()
        parent = os.getpid()
        # signals wait until the copy ignores them
        former = signal.pthread_sigmask(signal.SIG_BLOCK, _PARENTS)
        try:
            with warnings.catch_warnings():
                # the other threads wait or print; neither is needed in the copy
                warnings.simplefilter("ignore", DeprecationWarning)
                pid = os.fork()
            if pid == 0:
                try:
                    os.close(here_writes)
                    os.close(here_reads)
                    _become_worker(parent, slot)
                    signal.pthread_sigmask(signal.SIG_SETMASK, former)
                    self._serve(os.fdopen(child_reads, "rb"), os.fdopen(child_writes, "wb"))
                finally:
                    os._exit(0)
        except OSError:
            for descriptor in (child_reads, child_writes, here_reads, here_writes):
                os.close(descriptor)
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, former)
        os.close(child_reads)
        os.close(child_writes)
        self._pid: int | None = pid
        self._lock = threading.Lock()
        self._jobs = os.fdopen(here_writes, "wb")
        self._results = os.fdopen(here_reads, "rb")

    def do(self, function: Callable[[Given], Returned], job: Given) -> Returned:
        """The function's result.  Raises LostError: the copy has ended, or the function raised."""
        try:
            _send(self._jobs, (self._functions.index(function), job), self._known)
            done, result = _received(self._results, self._known)
        except (OSError, EOFError, ValueError) as error:
            self.end()  # its call is not under way any more
            raise LostError from error
        if not done:
            raise LostError
        return result  # type: ignore[no-any-return]

    def end(self) -> None:
        """Kill the copy."""
        with self._lock:
            pid, self._pid = self._pid, None
        if pid is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, 0)
        fork_ended(self.slot)
        for stream in (self._results, self._jobs):
            with contextlib.suppress(OSError):
                stream.close()

    def _serve(self, jobs: BinaryIO, out: BinaryIO) -> None:
        """In the copy: do jobs until there are no more."""
        while True:
            try:
                number, job = _received(jobs, self._known)
            except EOFError:
                return
            try:
                answer = True, self._functions[number](job)
            except BaseException:
                answer = False, None
            _send(out, answer, self._known)


def end_with_parent(parent: int) -> None:
    """Let the system kill this process when its parent, or the parent's thread, ends.

    parent  number of that process; if it has ended already, this one ends here
    """
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_watch_parent, args=(parent,), daemon=True).start()
    if os.getppid() != parent:
        os._exit(1)


def _watch_parent(parent: int) -> None:
    """Where the system does not do it: end soon after the parent."""
    while os.getppid() == parent:
        time.sleep(_PARENT_S)
    os._exit(1)


def _become_worker(parent: int, slot: int) -> None:
    """Set up a copy: it ignores Ctrl-C, ends with its parent, and has output streams of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in _PARENTS[1:]:
        signal.signal(number, signal.SIG_DFL)
    end_with_parent(parent)
    gc.freeze()  # old objects stay shared with the parent
    # a thread that this process no longer has may have held the lock of the old ones
    sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), write_through=True)
    sys.stderr = io.TextIOWrapper(io.FileIO(2, "w", closefd=False), write_through=True)
    fork_started(slot)


def _send(stream: BinaryIO, message: object, known: Sequence[object]) -> None:
    """Write a message; `known` objects by their number."""
    numbers = {id(thing): number for number, thing in enumerate(known)}

    class Pickler(pickle.Pickler):
        def persistent_id(self, thing: Any) -> int | None:
            return numbers.get(id(thing))

    packed = io.BytesIO()
    Pickler(packed, pickle.HIGHEST_PROTOCOL).dump(message)
    content = packed.getbuffer()
    stream.write(len(content).to_bytes(_SIZE_BYTES, "little"))
    stream.write(content)
    stream.flush()


def _received(stream: BinaryIO, known: Sequence[object]) -> Any:
    """The next message.  Raises EOFError: the sender has ended."""
    size = stream.read(_SIZE_BYTES)
    if len(size) < _SIZE_BYTES:
        raise EOFError
    content = stream.read(int.from_bytes(size, "little"))

    class Unpickler(pickle.Unpickler):
        def persistent_load(self, number: Any) -> object:
            return known[number]

    return Unpickler(io.BytesIO(content)).load()


#: Jobs under way or done per copy, ahead of the oldest result.
_AHEAD = 4
#: Number of lost copies after which their job counts as the cause.
_MOST_LOST = 2


class ProcessLostError(RuntimeError):
    """A job has ended its process.  Scenario: compiled code divides by zero, or memory runs out."""


def stream(
    function: Callable[[Given], Returned],
    jobs: Iterable[Given],
    copies: int,
    check: Callable[[], None] = lambda: None,
) -> Generator[Returned | ProcessLostError]:
    """Results of jobs in their order, `copies` of them under way at a time.

    Jobs are taken one by one, no more than a few ahead of the results.  A killed copy is
    replaced, and its job repeated.  Closing the iterator ends the copies.

    function  called in copies of this process; it must not raise
    check     may raise while a result is waited for
    raises    OSError: this user may have no more processes; errors of `jobs`
    """
    remaining = iter(jobs)
    waiting: SimpleQueue[tuple[Given, Future[Returned | ProcessLostError]] | None] = SimpleQueue()
    idle: SimpleQueue[Fork | None] = SimpleQueue()
    lost: SimpleQueue[int] = SimpleQueue()
    alive: dict[int, Fork] = {}
    pending: deque[Future[Returned | ProcessLostError]] = deque()
    threads: list[threading.Thread] = []

    def begin_copy(slot: int) -> None:
        # by the thread that wants the results: a copy ends with the thread that made it
        alive[slot] = Fork(slot, [function], ())
        idle.put(alive[slot])

    def do(job: Given) -> Returned | ProcessLostError:
        for _ in range(_MOST_LOST):
            if (copy := idle.get()) is None:  # the iterator is closed
                idle.put(None)
                raise LostError
            try:
                result = copy.do(function, job)
            except LostError:
                copy.end()
                lost.put(copy.slot)
                continue
            except BaseException:  # the job cannot be pickled
                idle.put(copy)
                raise
            idle.put(copy)
            return result
        return ProcessLostError(f"ended its process {_MOST_LOST} times; is there enough memory?")

    def work() -> None:
        for job, future in iter(waiting.get, None):
            try:
                future.set_result(do(job))
            except BaseException as error:
                future.set_exception(error)

    try:
        for slot in range(copies):
            begin_copy(slot)
        for _ in range(copies):
            threads.append(threading.Thread(target=work, daemon=True))
            threads[-1].start()
        while True:
            for job in islice(remaining, _AHEAD * copies - len(pending)):
                pending.append(Future())
                waiting.put((job, pending[-1]))
            if not pending:
                return
            done = False
            while not done:
                done = bool(wait([pending[0]], _POLL_S).done)
                check()
                while not lost.empty():
                    begin_copy(lost.get())
            yield pending.popleft().result()
    finally:
        for copy in alive.values():
            copy.end()
        idle.put(None)
        for _ in threads:
            waiting.put(None)
        for thread in threads:
            thread.join()
