"""Properties and permissions of this computer: cores, scheduler, kernel, clock, memory."""

from __future__ import annotations

import os
import platform
import threading
import time
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: Priority of the arm's process; see `drivers.priority`.
REAL_TIME_PRIORITY = 20

_REAL_TIME_KERNEL = Path("/sys/kernel/realtime")
_CLOCK = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
_GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
_MEMORY = Path("/proc/meminfo")


@dataclass(frozen=True)
class Abilities:
    """Properties of a computer that need no measurement; None = the system does not report it.

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
    """Abilities of this computer, for this user."""
    return Abilities(
        _cores(), _may_run_in_real_time(), _kernel(), _read(_CLOCK), _read(_GOVERNOR), _free_bytes()
    )


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _may_run_in_real_time() -> bool:
    """Whether real-time scheduling is permitted, tried in a temporary thread."""
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
    if _read(_REAL_TIME_KERNEL) == "1":
        return f"{platform.release()}, PREEMPT_RT"
    kinds = [word for word in platform.version().split() if word.startswith("PREEMPT")]
    return ", ".join([platform.release(), *kinds])


def _free_bytes() -> int | None:
    for line in (_read(_MEMORY) or "").splitlines():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return None


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return None


_SLEEP_S = 0.001
_SPIN_S = 0.002
_SLEEPS_PER_SPIN = 20  # so that spinning takes a twelfth of a core


@dataclass(frozen=True)
class Stalls:
    """Overslept times, and longest gaps while spinning, s."""

    slept_s: NDArray[np.float64]
    spun_s: NDArray[np.float64]

    @property
    def longest_s(self) -> float:
        """The longest of either kind."""
        return max((float(s.max()) for s in (self.slept_s, self.spun_s) if len(s)), default=0.0)

    def __str__(self) -> str:
        def in_ms(values: NDArray[np.float64]) -> str:
            if not len(values):
                return "not measured"
            ms = 1e3 * np.quantile(values, [0.5, 0.99, 1.0])
            return f"median {ms[0]:.2f} ms, p99 {ms[1]:.1f}, longest {ms[2]:.1f}"

        return (
            f"this computer's own stalls: asleep {in_ms(self.slept_s)}; awake {in_ms(self.spun_s)}"
        )


class StallProbe:
    """Measures stalls within a `with`; `take` gives those since it was last called."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self._here, there = context.Pipe()
        self._process = context.Process(target=_probe, args=(there,), daemon=True)

    def __enter__(self) -> StallProbe:
        self._process.start()
        self._here.recv()  # it has begun
        return self

    def __exit__(self, *_: object) -> None:
        self._here.close()
        self._process.join()

    @property
    def pid(self) -> int | None:
        """Its process, which is not to be counted among those measured."""
        return self._process.pid

    def take(self) -> Stalls:
        """Stalls since the last call."""
        self._here.send(None)
        stalls: Stalls = self._here.recv()
        return stalls


def _probe(door: Connection) -> None:
    """Measure until the other end of `door` is closed, and report at each request."""
    door.send(None)
    slept_s: list[float] = []
    spun_s: list[float] = []
    try:
        while True:
            for _ in range(_SLEEPS_PER_SPIN):
                start_s = time.monotonic()
                time.sleep(_SLEEP_S)
                slept_s.append(time.monotonic() - start_s - _SLEEP_S)
            start_s = last_s = time.monotonic()
            gap_s = 0.0
            while last_s < start_s + _SPIN_S:
                now_s = time.monotonic()
                gap_s, last_s = max(gap_s, now_s - last_s), now_s
            spun_s.append(gap_s)
            if door.poll():
                door.recv()
                door.send(Stalls(np.array(slept_s), np.array(spun_s)))
                slept_s, spun_s = [], []
    except (EOFError, OSError):
        return
