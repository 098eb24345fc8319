"""Waiting for what another thread or process does; whether one lives; a port that is free."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from tools.processes import free_port, listens

__all__ = ["free_port", "is_alive", "listens", "wait_until"]

Reached = TypeVar("Reached")


def wait_until(
    reached: Callable[[], Reached], within_s: float = 90.0, why: Callable[[], object] = lambda: ""
) -> Reached:
    """What `reached` returns as soon as that is true; `why` is said if it comes too late.

    It is asked less and less often: a browser that is asked 200 times a second takes a core.
    """
    deadline_s, pause_s = time.monotonic() + within_s, 0.005
    while not (value := reached()):
        assert time.monotonic() < deadline_s, why() or "it did not happen in time"
        time.sleep(pause_s)
        pause_s = min(1.3 * pause_s, 0.1)
    return value


def is_alive(process: int) -> bool:
    """Whether a process, by its id, has not ended; one that nobody has waited for yet has."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
