"""Signs of life of a service for systemd: a step that hangs ends them."""

from __future__ import annotations

import time

from cell.plant.systemd import Notifier

#: A step that lasts longer is a program that hangs, s: the first one may compile.
LONGEST_STEP_S = 600.0
#: A service that waits shows itself within it, s.
_WAITING_S = 5.0


class SignsOfLife:
    """Tells systemd that the service lives, as long as its moving thread is heard of."""

    def __init__(self) -> None:
        self.notifier = Notifier()
        self._until_s = float("inf")
        self._due_s = time.monotonic()

    def step(self) -> None:
        """Something begins that may last as long as a step."""
        self._until_s = time.monotonic() + LONGEST_STEP_S

    def waiting(self) -> None:
        """The service looks around while it waits."""
        self._until_s = time.monotonic() + _WAITING_S

    def tell(self, *, paused: bool) -> None:
        """Tell systemd if it is due; called every so often.

        paused  a person is waited for, who may take long
        """
        watchdog_s, now_s = self.notifier.watchdog_s, time.monotonic()
        if watchdog_s is not None and (now_s < self._until_s or paused) and now_s >= self._due_s:
            self.notifier.alive()
            self._due_s = now_s + watchdog_s / 3.0
