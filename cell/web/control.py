"""Who has control of the cell: one page at a time; the others watch."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

#: A page that has not been heard of for so long has control no more, s.
LOST_S = 30.0


@dataclass(frozen=True)
class Holder:
    """Whoever has control: the page, and the person's name."""

    page: str
    name: str


class Control:
    """The right to command the cell; Stop is everybody's who may operate."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._holder: Holder | None = None
        self._heard_s = 0.0

    def take(self, page: str, name: str) -> Holder:
        """Take control if it is free, or from another page of one's own; whoever has it then."""
        with self._lock:
            holder = self._present()
            if holder is None or holder.name == name:
                self._holder, self._heard_s = Holder(page, name), self._now_s()
            assert self._holder is not None
            return self._holder

    def release(self, page: str) -> None:
        """Give control back; nothing happens if somebody else has it."""
        with self._lock:
            if self._holder is not None and self._holder.page == page:
                self._holder = None

    def heard(self, page: str) -> Holder | None:
        """A page is still there; who has control, None = nobody."""
        with self._lock:
            holder = self._present()
            if holder is not None and holder.page == page:
                self._heard_s = self._now_s()
            return holder

    def _present(self) -> Holder | None:
        if self._now_s() - self._heard_s > LOST_S:
            self._holder = None
        return self._holder
