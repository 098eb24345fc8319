"""How long this computer keeps a program waiting: the measure beside every time measured.

A process of its own sleeps a millisecond again and again, and now and then spins for two: what it
oversleeps is the scheduler's doing, a gap while it spins that of whoever takes the core away.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

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
        def told(values: NDArray[np.float64]) -> str:
            if not len(values):
                return "not measured"
            ms = 1e3 * np.quantile(values, [0.5, 0.99, 1.0])
            return f"median {ms[0]:.2f} ms, p99 {ms[1]:.1f}, longest {ms[2]:.1f}"

        return f"this computer's own stalls: asleep {told(self.slept_s)}; awake {told(self.spun_s)}"


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
    """Measure until the other end of `door` is closed, and tell whenever it is asked."""
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
