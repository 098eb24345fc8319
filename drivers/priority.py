"""Asks the operating system to run a process in real time, and bounds what it may do with that."""

from __future__ import annotations

import contextlib
import gc
import os
from pathlib import Path

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
    return raise_thread(priority)


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
