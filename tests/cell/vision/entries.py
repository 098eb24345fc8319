"""What only compiled code can call, with an entry for tests."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit


@cache
def entry(part: Any) -> Callable[..., Any]:
    """A function of compiled code that tests can call."""

    @njit
    def call(*given):
        return part(*given)

    return call
