"""Results of a long row of jobs as they come, done in copies of this process.

In contrast to `forks.Forks` nobody waits for all of them, so that a million results need no more
memory than a few; and a job that ends its process is a result too.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from cell.computer.forks import Fork, LostError

Given = TypeVar("Given")
Returned = TypeVar("Returned")

#: Whoever waits looks this often whether anybody still wants the results, s.
_LOOK_S = 0.05
#: Jobs that may be under way or done for each copy, before the result of the oldest is taken.
_AHEAD = 4
#: A job that so many copies were lost with is what ends them.
_MOST_LOST = 2


class ProcessLostError(RuntimeError):
    """A job ends its process.  Scenario: a user's compiled code divides by zero, or memory ends."""


@dataclass
class _Row(Generic[Given, Returned]):
    """Jobs that wait, are under way, or are done and not yet taken."""

    jobs: Iterator[tuple[int, Given]]
    changed: threading.Condition = field(default_factory=threading.Condition)
    again: list[tuple[int, Given]] = field(default_factory=list)
    lost: dict[int, int] = field(default_factory=dict)
    done: dict[int, Returned | ProcessLostError] = field(default_factory=dict)
    taken: int = 0
    given: int = 0
    all_given: bool = False
    ended: bool = False
    error: BaseException | None = None

    def next(self, ahead: int) -> tuple[int, Given] | None:
        """The next job, once there is room for its result; None = there are no more."""
        with self.changed:
            while not self.ended:
                if self.again:
                    return self.again.pop(0)
                if self.given - self.taken < ahead and (job := self._from_jobs()) is not None:
                    return job
                if self.all_given and self.given == self.taken + len(self.done):
                    break
                self.changed.wait(_LOOK_S)
            return None

    def _from_jobs(self) -> tuple[int, Given] | None:
        if self.all_given:
            return None
        try:
            job = next(self.jobs)
        except StopIteration:
            self.all_given = True
            return None
        except BaseException as error:  # of whoever makes the jobs
            self.error, self.ended = error, True
            return None
        self.given += 1
        return job

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
                self.again.append((number, job))
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
    known: Sequence[object] = (),
) -> Generator[Returned | ProcessLostError]:
    """Results of jobs in their order, `copies` of them under way at a time.

    Jobs are taken one by one, no more than a few ahead of the results.  A copy that was killed is
    replaced, and its job done again.  When the iterator is closed the copies end.

    function  called in copies of this process; it must not raise
    check     may raise while a result is waited for
    known     objects that are not pickled, as of `forks`
    raises    OSError: this user may have no more processes; what `jobs` raises
    """
    row = _Row[Given, Returned](iter(enumerate(jobs)))
    slots = [_Slot(function, number, known) for number in range(copies)]
    threads: list[threading.Thread] = []
    try:
        for slot in slots:
            slot.begin()
        for slot in slots:
            threads.append(threading.Thread(target=_work, args=(slot, row, copies), daemon=True))
            threads[-1].start()
        while (result := _next_result(row, slots, check)) is not None:
            yield result[0]
    finally:
        with row.changed:
            row.ended = True
            row.changed.notify_all()
        for slot in slots:
            slot.end()
        for thread in threads:
            thread.join()
        for slot in slots:  # one that was begun meanwhile
            slot.end()


def _next_result(
    row: _Row[Given, Returned], slots: Sequence[_Slot], check: Callable[[], None]
) -> tuple[Returned | ProcessLostError] | None:
    """The next in order, once it is there; None = there are no more."""
    while True:
        check()
        for slot in slots:
            slot.replace_if_lost()
        with row.changed:
            if row.error is not None:
                raise row.error
            if row.taken in row.done:
                result = row.done.pop(row.taken)
                row.taken += 1
                row.changed.notify_all()
                return (result,)
            if row.all_given and row.taken == row.given:
                return None
            row.changed.wait(_LOOK_S)


class _Slot:
    """Place of a copy, and of the one after it if it is killed."""

    def __init__(
        self, function: Callable[[Any], Any], number: int, known: Sequence[object]
    ) -> None:
        self._function = function
        self._number = number
        self._known = known
        self._copy: Fork | None = None
        self._there = threading.Event()
        self._ended = False

    def begin(self) -> None:
        """Make the copy."""
        self._copy = Fork(self._number, [self._function], self._known)
        self._there.set()

    def replace_if_lost(self) -> None:
        """Make another in place of one that was killed."""
        if self._copy is None and not self._ended:
            self.begin()

    def do(self, job: Any) -> Any:
        """The function's result.  Raises LostError."""
        while not self._there.wait(_LOOK_S):
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


def _work(slot: _Slot, row: _Row[Any, Any], copies: int) -> None:
    while (job := row.next(_AHEAD * copies)) is not None:
        try:
            row.put(job[0], slot.do(job[1]))
        except LostError:
            row.lose(*job)
        except BaseException as error:  # a job that cannot be pickled
            with row.changed:
                row.error = error
                row.changed.notify_all()
            return
