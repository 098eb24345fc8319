from __future__ import annotations

import itertools
import os
from collections.abc import Callable

import pytest

_numbers = itertools.count(2)


@pytest.fixture
def loopback() -> str:
    """An address of this computer that no other test uses."""
    worker = os.getpid() % 60000
    return f"127.{1 + worker // 250}.{1 + worker % 250}.{next(_numbers) % 250}"


@pytest.fixture
def eventually() -> Callable[..., None]:
    """Wait in real time for an emulator, which is another process."""
    import time

    def wait(holds: Callable[[], bool], seconds: float = 5.0) -> None:
        until = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < until, "it did not happen in time"
            time.sleep(0.005)

    return wait
