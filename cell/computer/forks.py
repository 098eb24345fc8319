"""Jobs on all cores at once, each core with a Python lock of its own: in forks of this process.

A fork has all that this process has when it is made, so that a job needs no more than is said of
it, and it computes what this process would.  On other systems than Linux this process does all.
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
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any, BinaryIO, Generic, TypeVar

from cell.computer.watched import MOST_FORKS, fork_ended, fork_started

Given = TypeVar("Given")
Returned = TypeVar("Returned")

#: While forks are waited for, whoever waits looks this often whether anybody still wants it, s.
_POLL_S = 0.05
_SIZE_BYTES = 8
#: Where the system does not tell that a parent has ended, a process looks this often, s.
_PARENT_S = 1.0
#: Of prctl: the signal that a process gets when the one that made it has ended.
_PR_SET_PDEATHSIG = 1


#: Signals whose handlers are this process's alone.
_PARENTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class LostError(Exception):
    """A fork has ended, or could not do a job."""


class Forks:
    """This process, and copies of it that do jobs beside it while `forks` is open."""

    def __init__(self, workers: Sequence[Fork]) -> None:
        self._workers = workers

    def map(
        self,
        function: Callable[[Given], Returned],
        jobs: Sequence[Given],
        done: Callable[[Given, Returned], None] = lambda job, result: None,
        check: Callable[[], None] = lambda: None,
    ) -> list[Returned]:
        """Results of all jobs, in their order; what a job does besides is lost if a copy did it.

        Whichever core is free takes the next.  A job that a copy could not do, because it was
        killed or the function raised, is done again by this process.

        function  one of those that `forks` was opened with
        done      is told of every job as its result comes, by any thread
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
        """End the copies, whatever they are doing."""
        for worker in self._workers:
            worker.end()


@contextmanager
def forks(
    functions: Sequence[Callable[[Any], Any]],
    *,
    most: int,
    known: Iterable[object] = (),
) -> Iterator[Forks]:
    """Copies of this process in which any of the functions may be called, until it is left.

    most   at most so many jobs at a time, those of this process included
    known  objects that are not pickled: a copy has them, and what it gives back has this process's
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
        self._slot = slot
        self._functions = functions
        self._known = known
        child_reads, here_writes = os.pipe()
        here_reads, child_writes = os.pipe()
        parent = os.getpid()
        # a signal waits until the copy knows that it is none of its business
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
        self._ending = threading.Lock()
        self._jobs = os.fdopen(here_writes, "wb")
        self._results = os.fdopen(here_reads, "rb")

    def do(self, function: Callable[[Given], Returned], job: Given) -> Returned:
        """The function's result.  Raises LostError: the copy has ended, or the function raised."""
        try:
            _send(self._jobs, (self._functions.index(function), job), self._known)
            done, result = _received(self._results, self._known)
        except (OSError, EOFError, ValueError) as error:
            self.end()  # what it was doing is not under way any more
            raise LostError from error
        if not done:
            raise LostError
        return result  # type: ignore[no-any-return]

    def end(self) -> None:
        """Kill the copy."""
        with self._ending:
            pid, self._pid = self._pid, None
        if pid is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, 0)
        fork_ended(self._slot)
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
    """Have the system kill this process when the thread that made it ends, or its process.

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
    """What sets a copy apart: it hears no Ctrl-C, ends with its parent, and never prints by it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in _PARENTS[1:]:
        signal.signal(number, signal.SIG_DFL)
    end_with_parent(parent)
    gc.freeze()  # what is old stays shared with the parent
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
    """The next message.  Raises EOFError: whoever sent them has ended."""
    size = stream.read(_SIZE_BYTES)
    if len(size) < _SIZE_BYTES:
        raise EOFError
    content = stream.read(int.from_bytes(size, "little"))

    class Unpickler(pickle.Unpickler):
        def persistent_load(self, number: Any) -> object:
            return known[number]

    return Unpickler(io.BytesIO(content)).load()


#: Whoever waits looks this often whether anybody still wants the results, s.
#: Jobs that may be under way or done for each copy, before the result of the oldest is taken.
_AHEAD = 4
#: A job that so many copies were lost with is what ends them.
_MOST_LOST = 2


class ProcessLostError(RuntimeError):
    """A job ends its process.  Scenario: a user's compiled code divides by zero, or memory ends."""


@dataclass
class _JobRow(Generic[Given, Returned]):
    """Jobs that wait, are under way, or are done and not yet taken.

    given, taken  how many jobs were begun or wait, and of how many the result was taken
    """

    changed: threading.Condition = field(default_factory=threading.Condition)
    waiting: deque[tuple[int, Given]] = field(default_factory=deque)
    lost: dict[int, int] = field(default_factory=dict)
    done: dict[int, Returned | ProcessLostError] = field(default_factory=dict)
    given: int = 0
    taken: int = 0
    ended: bool = False
    error: BaseException | None = None

    def give(self, job: Given) -> None:
        """One more job waits."""
        with self.changed:
            self.waiting.append((self.given, job))
            self.given += 1
            self.changed.notify_all()

    def next(self) -> tuple[int, Given] | None:
        """The next job, once there is one; None = there will be no more."""
        with self.changed:
            while not self.waiting and not self.ended:
                self.changed.wait()
            return None if self.ended else self.waiting.popleft()

    def take(self) -> tuple[Returned | ProcessLostError] | None:
        """The next result in order; None = it is not there yet, after a while."""
        with self.changed:
            if self.error is not None:
                raise self.error
            if self.taken not in self.done:
                self.changed.wait(_POLL_S)
            if self.taken not in self.done:
                return None
            self.taken += 1
            return (self.done.pop(self.taken - 1),)

    def put(self, number: int, result: Returned | ProcessLostError) -> None:
        """A job is done."""
        with self.changed:
            self.done[number] = result
            self.changed.notify_all()

    def lose(self, number: int, job: Given) -> None:
        """The copy that did a job has ended: it is done again, if it has not ended two."""
        with self.changed:
            self.lost[number] = self.lost.get(number, 0) + 1
            if self.lost[number] < _MOST_LOST:
                self.waiting.appendleft((number, job))
            else:
                self.done[number] = ProcessLostError(
                    f"ended its process {_MOST_LOST} times; is there enough memory?"
                )
            self.changed.notify_all()


def stream(
    function: Callable[[Given], Returned],
    jobs: Iterable[Given],
    copies: int,
    check: Callable[[], None] = lambda: None,
) -> Generator[Returned | ProcessLostError]:
    """Results of jobs in their order, `copies` of them under way at a time.

    Jobs are taken one by one, no more than a few ahead of the results.  A copy that was killed is
    replaced, and its job done again.  When the iterator is closed the copies end.

    function  called in copies of this process; it must not raise
    check     may raise while a result is waited for
    raises    OSError: this user may have no more processes; what `jobs` raises
    """
    row, left = _JobRow[Given, Returned](), iter(jobs)
    slots = [_Slot(function, number) for number in range(copies)]
    threads: list[threading.Thread] = []
    try:
        for slot in slots:
            slot.begin()
        for slot in slots:
            threads.append(threading.Thread(target=_work, args=(slot, row), daemon=True))
            threads[-1].start()
        while True:
            for job in islice(left, _AHEAD * copies - (row.given - row.taken)):
                row.give(job)
            if row.taken == row.given:
                return
            while (result := row.take()) is None:
                check()
                for slot in slots:
                    slot.replace_if_lost()
            check()
            yield result[0]
    finally:
        with row.changed:
            row.ended = True
            row.changed.notify_all()
        for slot in slots:
            slot.end()
        for thread in threads:
            thread.join()


class _Slot:
    """Place of a copy, and of the one after it if it is killed."""

    def __init__(self, function: Callable[[Any], Any], number: int) -> None:
        self._function = function
        self._number = number
        self._copy: Fork | None = None
        self._there = threading.Event()
        self._ended = False

    def begin(self) -> None:
        """Make the copy."""
        self._copy = Fork(self._number, [self._function], ())
        self._there.set()

    def replace_if_lost(self) -> None:
        """Make another in place of one that was killed."""
        if self._copy is None and not self._ended:
            self.begin()

    def do(self, job: Any) -> Any:
        """The function's result.  Raises LostError."""
        while not self._there.wait(_POLL_S):
            if self._ended:
                raise LostError
        copy = self._copy
        assert copy is not None
        try:
            return copy.do(self._function, job)
        except LostError:
            copy.end()
            self._there.clear()
            self._copy = None
            raise

    def end(self) -> None:
        """No copy any more."""
        self._ended = True
        if (copy := self._copy) is not None:
            copy.end()


def _work(slot: _Slot, row: _JobRow[Any, Any]) -> None:
    while (job := row.next()) is not None:
        try:
            row.put(job[0], slot.do(job[1]))
        except LostError:
            row.lose(*job)
        except BaseException as error:  # a job that cannot be pickled
            with row.changed:
                row.error = error
                row.changed.notify_all()
            return
