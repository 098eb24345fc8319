"""A second process, which computes while this one processes frames."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from multiprocessing import active_children, get_context, parent_process
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Returned = TypeVar("Returned")

#: Nice value: on a slow computer the processing of frames goes first.
_NICE = 5
_NICEST = 19  # there is nothing beyond


class SecondProcess(Executor):
    """Executor of one job at a time in a process of its own, apart from this one's Python lock.

    It starts with the first job, is restarted after it was killed, and ends with this process
    in every case.  Jobs are functions of a module; they, their arguments and results are pickled.
    """

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._pid: Future[int] = Future()

    def submit(
        self, fn: Callable[Given, Returned], /, *args: Given.args, **kwargs: Given.kwargs
    ) -> Future[Returned]:
        """See `Executor`; a job whose process is killed raises BrokenExecutor."""
        if self._pool is not None:
            try:
                return self._pool.submit(fn, *args, **kwargs)
            except BrokenExecutor:
                self.shutdown(wait=False)
        self._pool = ProcessPoolExecutor(1, get_context("spawn"), initializer=_begin)
        self._pid = self._pool.submit(os.getpid)
        return self._pool.submit(fn, *args, **kwargs)

    @contextlib.contextmanager
    def hurried(self) -> Iterator[None]:
        """Within the `with` jobs have the priority of this process, because it waits for one; where
        this user may not raise it, it stays.
        """
        self._schedule(0)
        try:
            yield
        finally:
            self._schedule(_NICE)

    def _schedule(self, nice: int) -> None:
        if (process := self._process()) is None:
            return
        with contextlib.suppress(OSError):  # not permitted
            own = os.getpriority(os.PRIO_PROCESS, 0)
            os.setpriority(os.PRIO_PROCESS, process, min(own + nice, _NICEST))

    def _process(self) -> int | None:
        """Number of the process; None = it does not run, and the number may be another's by now."""
        if self._pool is None or not self._pid.done() or self._pid.exception() is not None:
            return None
        process = self._pid.result()
        return process if any(child.pid == process for child in active_children()) else None

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the process: after its job with `wait`, else at once."""
        if self._pool is None:
            return
        process = self._process()
        pool, self._pool = self._pool, None
        if not wait and process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        pool.shutdown(wait, cancel_futures=cancel_futures)


def _begin() -> None:
    """Lower the priority, leave Ctrl-C to the first process, and end with it."""
    os.nice(_NICE)
    for number in (signal.SIGINT, signal.SIGHUP):  # of the terminal, for the first process
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    try:
        parent = parent_process()
        assert parent is not None
        parent.join()
    finally:
        os._exit(1)
