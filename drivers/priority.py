"""Asks the operating system to run a process in real time, and bounds what it may do with that."""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Iterable
from pathlib import Path

#: Of threads that are no longer in real time: the highest there is.
_BEFORE_ORDINARY_ONES = -20
_PRECEDENCE = -10
_SESSION = Path("/proc/self/autogroup")


def run_in_real_time(priority: int = 20) -> bool:
    """Schedule this process, and the threads it will start, before ordinary ones.

    What is imported by now is kept for good: the garbage collector need not look through it, which
    would take ten milliseconds now and then.
    returns  False where the system has no such thing or this user may not ask for it (a limit
             `rtprio` of at least `priority` allows it); the process then runs as before
    """
    gc.collect()
    gc.freeze()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, PermissionError):
        return False
    return True


def raise_thread(priority: int) -> bool:
    """Schedule the calling thread before ordinary ones, and the threads that it will start.

    For threads that wait nearly all the time: what they wait for must not be missed.
    priority  1 … 99 of the real-time scheduler; the arm's process has 20
    returns   False where this is not permitted; the thread then runs as before
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, PermissionError):
        return False
    return True


def take_precedence() -> bool:
    """Run the calling thread, and the threads and processes that it will start, before others'.

    Linux shares a computer among sessions first, where it groups them; so the session's share is
    raised too, with all that runs in it.
    returns  False where this is not permitted (a limit `nice` of -10 allows it)
    source   sched(7), "The autogroup feature"
    """
    try:
        os.setpriority(os.PRIO_PROCESS, 0, min(_PRECEDENCE, os.getpriority(os.PRIO_PROCESS, 0)))
    except (AttributeError, OSError):
        return False
    with contextlib.suppress(OSError):
        _SESSION.write_text(str(_PRECEDENCE))
    return True


def own_threads() -> set[int]:
    """System numbers of this process's threads; empty where they cannot be listed."""
    try:
        return {int(task.name) for task in Path("/proc/self/task").iterdir()}
    except OSError:
        return set()


def poll_gently(threads: Iterable[int], slack_s: float) -> None:
    """Let threads of this process that only poll wake up together with others, not in real time.

    A client of ur-rtde looks every 100 µs whether something has come, which costs a good part of a
    core in real time and little with some slack.

    threads  numbers as of `own_threads`; one that has ended by now is passed over
    slack_s  by how much later than asked they may wake up, s
    Nothing happens where the system has no such thing or does not permit it.
    """
    for thread in threads:
        with contextlib.suppress(AttributeError, OSError):
            if os.sched_getscheduler(thread) != os.SCHED_OTHER:
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
                os.setpriority(os.PRIO_PROCESS, thread, _BEFORE_ORDINARY_ONES)
        with contextlib.suppress(OSError):
            Path(f"/proc/{thread}/timerslack_ns").write_text(str(round(slack_s * 1e9)))


def bound_spinning(seconds: float) -> None:
    """End this process when it computes in real time for that long without ever waiting.

    ur-rtde spins while it waits for a controller that has fallen silent, and would keep everything
    else off a core.  Without real-time scheduling, or where there is no such limit, nothing
    happens.
    """
    with contextlib.suppress(ImportError, AttributeError):
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_RTTIME)
        resource.setrlimit(resource.RLIMIT_RTTIME, (round(seconds * 1e6), hard))
