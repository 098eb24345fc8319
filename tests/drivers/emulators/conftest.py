from __future__ import annotations

from collections.abc import Callable

import pytest


@pytest.fixture
def loopback(free_loopback: Callable[[], str]) -> str:
    """An address of this computer that no other test uses."""
    return free_loopback()
