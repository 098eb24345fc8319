"""Keeps a cell's memory from growing from cycle to cycle."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from functools import cache

#: Parameters of glibc's mallopt.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
#: Free bytes that stay with the process: of one array, and in all.  A frame has 1 to 5 MB.
_KEPT_ARRAY_BYTES, _KEPT_BYTES = 16 * 2**20, 64 * 2**20


def use_one_arena() -> None:
    """Have all later threads allocate from one heap, where the C library is glibc.

    It gives every thread an arena of its own, of which fragments stay when the thread has ended,
    so that a cell grows from cycle to cycle.
    """
    _of_libc("mallopt")(_M_ARENA_MAX, 1)


def reuse_freed_memory() -> None:
    """Have arrays take the memory of freed ones, where the C library is glibc.

    It returns a freed frame's pages to the system, which clears them for the next frame: a quarter
    of the time in which a recording is finished.  Up to 64 MB of free memory stay with the process.
    """
    set_parameter = _of_libc("mallopt")
    set_parameter(_M_MMAP_THRESHOLD, _KEPT_ARRAY_BYTES)
    set_parameter(_M_TRIM_THRESHOLD, _KEPT_BYTES)


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
