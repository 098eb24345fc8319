"""How the engine's functions are compiled, and when compiled code on disk is out of date."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from numba import njit

#: Fused multiply-add is allowed, reordering is not: results do not depend on the vector width.
FASTMATH = {"contract", "nsz"}

F = TypeVar("F", bound=Callable[..., Any])

inline = njit(fastmath=FASTMATH, error_model="numpy", forceinline=True)


@lru_cache(maxsize=1)
def fingerprint() -> str:
    """Hash of this package's sources: compiled code of other sources is never used."""
    digest = hashlib.sha256()
    here = Path(__file__).parent
    for path in sorted([*here.glob("*.py"), here / "effects/base.py", here / "effects/pointer.py"]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def compiled(function: F) -> F:
    """Compile on first use, without the interpreter lock, and keep the machine code on disk.

    numba compares the time stamp of the function's own file only, and so would run old code after
    a change in a file that the function calls into; here the stamp is the whole package's hash.
    """
    options: dict[str, Any] = {"fastmath": FASTMATH, "error_model": "numpy", "nogil": True}
    try:
        dispatcher: Any = njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no folder that it may write to
        return njit(**options)(function)  # type: ignore[no-any-return]
    dispatcher._cache._cache_file._source_stamp = fingerprint()
    return dispatcher  # type: ignore[no-any-return]
