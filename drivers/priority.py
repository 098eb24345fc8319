"""Asks the operating system to run a process in real time, and bounds what it may do with that."""

from __future__ import annotations

import contextlib
import gc
import os


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
