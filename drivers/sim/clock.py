"""Simulated time: sleeping advances it at once, and triggers the events that it passes."""

from __future__ import annotations

import heapq
import itertools
import math
import threading
import time
from collections.abc import Callable

#: A simulation in real time that is later than this goes on from there; less it makes up for, s.
MOST_LATE_S = 0.5
#: In real time the clock goes on in steps of at most this, s: others read it, and plan events.
STEP_S = 0.005


class SimClock:
    """Time that passes only when somebody sleeps; everything in between is instantaneous.

    One thread lets time pass; others may read it and act on devices meanwhile.

    real_time_factor  None = at once; 1.0 = at the speed of reality; 10.0 = ten times.  The
                      computing time passes too, as in reality.
    """

    def __init__(self, start_s: float = 0.0, real_time_factor: float | None = None) -> None:
        if real_time_factor is not None and not real_time_factor > 0.0:
            raise ValueError(f"real_time_factor = {real_time_factor}: must be > 0")
        self._now_s = start_s
        self._factor = real_time_factor
        self._anchor_s = (start_s, time.perf_counter())
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._number = itertools.count()
        self._lock = threading.RLock()

    def now_s(self) -> float:
        """Simulated seconds since the start."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Forward time.  Raises ValueError: duration_s < 0 or not finite."""
        if not 0.0 <= duration_s < float("inf"):
            raise ValueError(f"sleep of {duration_s} s: must be finite and >= 0")
        self.forward_to_s(self._now_s + duration_s)

    def forward_to_s(self, t_s: float) -> None:
        """Forward time to `t_s`, running the events on the way; does nothing if that has passed."""
        while True:
            steps_until_s = math.inf if self._factor is None else self._now_s + STEP_S
            act = None
            with self._lock:
                event_s = self._events[0][0] if self._events else math.inf
                next_s = min(t_s, event_s, steps_until_s)
                if event_s == next_s:
                    act = heapq.heappop(self._events)[2]
            self._pass_until(next_s)
            if act is not None:
                act()
            elif next_s == t_s:
                return

    def call_at(self, t_s: float, act: Callable[[], None]) -> None:
        """Run `act` when time passes `t_s` (in the thread that lets it pass)."""
        with self._lock:
            heapq.heappush(self._events, (t_s, next(self._number), act))

    def _pass_until(self, t_s: float) -> None:
        if t_s <= self._now_s:
            return
        if self._factor is not None:
            simulated_s, real_s = self._anchor_s
            early_s = real_s + (t_s - simulated_s) / self._factor - time.perf_counter()
            if early_s > 0.0:
                time.sleep(early_s)
            elif early_s < -MOST_LATE_S:
                self._anchor_s = (t_s, time.perf_counter())
        self._now_s = t_s
