"""CPU time of a program."""

from __future__ import annotations

import resource


def cpu_s() -> float:
    """CPU time of this process and of those that it started and that have ended, s."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)
