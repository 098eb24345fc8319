from __future__ import annotations

import time
from collections.abc import Callable

import pytest


@pytest.fixture
def loopback(free_loopback: Callable[[], str]) -> str:
    """An address of this computer that no other test uses."""
    return free_loopback()


@pytest.fixture
def eventually() -> Callable[..., None]:
    """Wait in real time for an emulator, which is another process."""

    def wait(holds: Callable[[], bool], seconds: float = 5.0) -> None:
        until = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < until, "it did not happen in time"
            time.sleep(0.005)

    return wait
