"""Memory that a UR arm's two processes share: flags both ways, and a ring of measured samples.

Every number is an aligned 8-byte float, written atomically; each has one writer.
"""

from __future__ import annotations

import mmap
from bisect import bisect_left
from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from drivers.interfaces import FloatArray

#: Stored samples: two minutes at 500 Hz.
RING = 60_000


class Slot(IntEnum):
    """Positions of numbers in the shared header, and which process writes each."""

    STOPS = 0  # parent: number of requested stops
    HEARTBEAT_S = 1  # child: monotonic time of its last cycle; nan while it is busy
    SAMPLES = 2  # child: number of samples written so far
    MODE = 3  # child: index of the ArmMode
    STREAMING = 4  # child: 1 while it streams a path
    PATHS = 5  # child: number of commanded paths
    WORST_PERIOD_S = 6  # child: longest time between two commands of a path
    LATE_PERIODS = 7  # child: number of such times above 1.25 periods
    PERIODS = 8  # child: number of such times
    SPEED = 9  # child: share of the full speed that the controller allows
    REVISIONS = 11  # child: number of commanded changes of a path
    REVISED = 12  # child: number of those that were accepted
    FOLLOWED = 13  # child: number of commanded paths that were accepted
    SLOWED = 10  # child: 1 from when a path was broken off because it was slowed until a reset


class SharedColumn(IntEnum):
    """Columns of a sample."""

    T_S = 0  # on the cell's clock
    TCP = 1  # … to 6, the tool's pose as the controller writes it
    SPEED_M_PER_S = 7
    Q1_RAD = 8  # … to 13, the joints


COLUMNS = 14
_HEADER = 16
SIZE_BYTES = 8 * (_HEADER + RING * COLUMNS)
_AT_ONCE: int = getattr(mmap, "MAP_POPULATE", 0)  # Linux


class SharedState:
    """Header and ring in a file that both processes have mapped."""

    def __init__(self, descriptor: int) -> None:
        # populated at once: no page fault during a motion
        self._map = mmap.mmap(descriptor, SIZE_BYTES, flags=mmap.MAP_SHARED | _AT_ONCE)
        numbers: FloatArray = np.frombuffer(self._map, dtype=np.float64)
        self._header = numbers[:_HEADER]
        self._ring = numbers[_HEADER:].reshape(RING, COLUMNS)

    def get(self, slot: Slot) -> float:
        """A number of the header."""
        return float(self._header[slot])

    def put(self, slot: Slot, value: float) -> None:
        """Write a number of the header."""
        self._header[slot] = value

    def add(self, slot: Slot) -> None:
        """Increment a number of the header."""
        self._header[slot] += 1.0

    def write_sample(self, sample: Sequence[float] | FloatArray) -> None:
        """Append a sample (14,)."""
        count = int(self._header[Slot.SAMPLES])
        self._ring[count % RING] = sample
        self._header[Slot.SAMPLES] = count + 1

    def samples(self, most: int = RING // 2) -> FloatArray:
        """(n, 14) the last samples, oldest first; at most half the ring, so that none is being
        overwritten while it is copied."""
        count = int(self._header[Slot.SAMPLES])
        return self._between(count - min(count, most, RING // 2), count)

    def samples_since(self, t_s: float) -> FloatArray:
        """(n, 14) those not before a time, of the last half of the ring; only these are copied."""
        count = int(self._header[Slot.SAMPLES])
        last = range(max(0, count - RING // 2), count)
        first = bisect_left(last, t_s, key=lambda k: float(self._ring[k % RING, SharedColumn.T_S]))
        return self._between(last.start + first, count)

    def _between(self, first: int, end: int) -> FloatArray:
        return np.array(self._ring[np.arange(first, end) % RING])
