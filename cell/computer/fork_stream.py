"""Results of a long row of jobs as they come, done in copies of this process.

In contrast to `forks.Forks` nobody waits for all of them, so that a million results need no more
memory than a few; and a job that ends its process is a result too.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from itertools import islice
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
                self.changed.wait(_LOOK_S)
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
