"""What this computer is and permits: cores, scheduler, kernel, clock, memory."""

from __future__ import annotations

import os
import platform
import threading
from dataclasses import dataclass
from pathlib import Path

#: Priority of the arm's process; see `drivers.priority`.
REAL_TIME_PRIORITY = 20

_REAL_TIME_KERNEL = Path("/sys/kernel/realtime")
_CLOCK = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
_GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
_MEMORY = Path("/proc/meminfo")


@dataclass(frozen=True)
class Abilities:
    """What can be said of a computer without measuring; None = this system does not say it.

    cores               that this process may use
    real_time           whether this user may schedule in real time
    kernel              release, and how it lets programs interrupt each other
    clock               source of the monotonic clock, e.g. tsc
    governor            of the first core's frequency, e.g. performance
    free_memory_bytes   that programs can have
    """

    cores: int
    real_time: bool
    kernel: str
    clock: str | None
    governor: str | None
    free_memory_bytes: int | None


def abilities() -> Abilities:
    """Those of this computer, for this user."""
    return Abilities(
        _cores(), _may_run_in_real_time(), _kernel(), _said(_CLOCK), _said(_GOVERNOR), _free_bytes()
    )


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _may_run_in_real_time() -> bool:
    """Tried by a thread of its own, which ends."""
    granted = []

    def ask() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))
        except (AttributeError, OSError):
            return
        granted.append(True)

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    return bool(granted)


def _kernel() -> str:
    if _said(_REAL_TIME_KERNEL) == "1":
        return f"{platform.release()}, PREEMPT_RT"
    kinds = [word for word in platform.version().split() if word.startswith("PREEMPT")]
    return ", ".join([platform.release(), *kinds])


def _free_bytes() -> int | None:
    for line in (_said(_MEMORY) or "").splitlines():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return None


def _said(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return None
