"""Keeps a cell's memory from growing from cycle to cycle."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from functools import cache

_M_ARENA_MAX = -8  # of glibc's mallopt


def use_one_arena() -> None:
    """Have all later threads allocate from one heap, where the C library is glibc.

    It gives every thread an arena of its own, of which fragments stay when the thread has ended,
    so that a cell grows from cycle to cycle.
    """
    _of_libc("mallopt")(_M_ARENA_MAX, 1)


def freeze_loaded_objects() -> None:
    """Exempt all objects loaded so far from garbage collection: they are never freed.

    Otherwise each full collection scans all of them, and no other thread of Python, such as a
    camera's, runs meanwhile.
    """
    gc.collect()
    gc.freeze()


def release_free_memory() -> None:
    """Collect unreachable objects, and let the C library return its free pages, where it can.

    glibc keeps the pages of freed arrays among those still used.
    """
    gc.collect()
    _of_libc("malloc_trim")(0)


@cache
def _of_libc(name: str) -> Callable[..., int]:
    try:
        function: Callable[..., int] = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):
        return lambda *_: 0
    return function
