"""Requests real-time scheduling from the operating system, and limits its use."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
from collections.abc import Iterable
from pathlib import Path

#: Nice values: of threads that are not in real time for a moment, and of the cell.
_BEFORE_ORDINARY_ONES = -20
_PRECEDENCE = -10
_SESSION = Path("/proc/self/autogroup")


def run_in_real_time(priority: int = 20) -> bool:
    """Schedule this process and its later threads in real time (SCHED_FIFO).

    Objects imported by now are never freed: to scan them would take the garbage collector
    ten milliseconds now and then.
    returns  False where the system has no such thing or this user may not ask for it (a limit
             `rtprio` of at least `priority` allows it); the process then runs as before
    """
    gc.collect()
    gc.freeze()
    return raise_thread(priority)


def raise_thread(priority: int) -> bool:
    """Schedule the calling thread and those that it will start in real time (SCHED_FIFO).

    For threads that wait nearly all the time for events that must not be missed.
    priority  1 … 99 of the real-time scheduler; the arm's process has 20
    returns   False where this is not permitted; the thread then runs as before
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, PermissionError):
        return False
    return True


def take_precedence() -> bool:
    """Raise the priority of the calling thread, and of the threads and processes it will start.

    Linux shares a computer among sessions first, where it groups them; so the session's share is
    raised too, with all that runs in it, until this process ends.
    returns  False where this is not permitted (a limit `nice` of -10 allows it)
    source   sched(7), "The autogroup feature"
    """
    try:
        os.setpriority(os.PRIO_PROCESS, 0, min(_PRECEDENCE, os.getpriority(os.PRIO_PROCESS, 0)))
    except (AttributeError, OSError):
        return False
    with contextlib.suppress(OSError, ValueError):
        if (before := session_nice()) > _PRECEDENCE:
            set_session_nice(_PRECEDENCE)
            atexit.register(set_session_nice, before)
    return True


def session_nice() -> int:
    """Nice value of this process's session.  Raises OSError, ValueError: the system has none."""
    return int(_SESSION.read_text().rpartition(" ")[2])


def set_session_nice(nice: int) -> None:
    """Set the nice value, -20 … 19, of this process's session, where that is permitted."""
    with contextlib.suppress(OSError):
        _SESSION.write_text(str(nice))


def own_threads() -> set[int]:
    """System numbers of this process's threads; empty where they cannot be listed."""
    try:
        return {int(task.name) for task in Path("/proc/self/task").iterdir()}
    except OSError:
        return set()


class Pollers:
    """Threads of this process that poll every 100 µs, as ur-rtde's do.

    In real time each takes a fifth of a core.  While their user sleeps they are not needed: they
    may then wake up later, at ordinary priority.  While it is awake they are in real time, too,
    since it may wait for them without sleeping.

    threads  numbers as of `own_threads`
    slack_s  largest delay of their wake-ups while their user sleeps, s
    Nothing is changed where the calling thread is not in real time, or may not change others.
    """

    def __init__(self, threads: Iterable[int], slack_s: float) -> None:
        self._threads: dict[int, int] = {}
        with contextlib.suppress(AttributeError, OSError):
            self._policy, self._as_now = os.sched_getscheduler(0), os.sched_getparam(0)
            if self._policy != os.SCHED_FIFO:
                return
            self._ordinary, self._slack_ns = os.sched_param(0), str(round(slack_s * 1e9)).encode()
            for thread in threads:
                os.setpriority(os.PRIO_PROCESS, thread, _BEFORE_ORDINARY_ONES)
            # Linux drops the slack of a real-time thread, so it is set each time
            self._threads = {t: os.open(f"/proc/{t}/timerslack_ns", os.O_WRONLY) for t in threads}

    def eased(self) -> Pollers:
        """Within a `with` they wake up later; afterwards in time again."""
        return self

    def __enter__(self) -> None:
        for thread, slack in self._threads.items():
            self._schedule(thread, os.SCHED_OTHER, self._ordinary)
            with contextlib.suppress(OSError):  # it has ended
                os.write(slack, self._slack_ns)

    def __exit__(self, *_: object) -> None:
        for thread in self._threads:
            self._schedule(thread, self._policy, self._as_now)

    @staticmethod
    def _schedule(thread: int, policy: int, parameters: os.sched_param) -> None:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, policy, parameters)


def bound_spinning(seconds: float) -> None:
    """Let the system end this process if it computes in real time for so long without waiting.

    ur-rtde spins while it waits for a controller that has fallen silent, and would keep everything
    else off a core.  Without real-time scheduling, or where there is no such limit, nothing
    happens.
    """
    with contextlib.suppress(ImportError, AttributeError):
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_RTTIME)
        soft = round(seconds * 1e6)
        if hard != resource.RLIM_INFINITY:  # the administrator's limit is lower
            soft = min(soft, hard)
        resource.setrlimit(resource.RLIMIT_RTTIME, (soft, hard))
