"""The cell's clock in the real world."""

from __future__ import annotations

import time


class RealClock:
    """Monotonic time of this computer."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start; the same for all processes of this computer."""
        return time.monotonic()

    def sleep_s(self, duration_s: float) -> None:
        """Wait.  Raises ValueError: duration_s < 0 or not finite."""
        if not 0.0 <= duration_s < float("inf"):
            raise ValueError(f"sleep of {duration_s} s: must be finite and >= 0")
        time.sleep(duration_s)


def sleep_until(t_s: float) -> None:
    """Wait until a moment on the real clock; not at all if it has passed."""
    remaining_s = t_s - time.monotonic()
    if remaining_s > 0.0:
        time.sleep(remaining_s)
