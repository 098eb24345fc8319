"""How numerical functions are compiled, and when compiled code on disk is out of date."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numba
from llvmlite.binding import get_host_cpu_features
from numba import njit, types
from numba.core.event import Event, Listener, register
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic

#: Fused multiply-add is allowed, reordering is not: results do not depend on the vector width.
FASTMATH = {"contract", "nsz"}

#: Numbers side by side in a vector register of this processor; 4 where there are fewer.
WIDEST = 8 if get_host_cpu_features().get("avx512f") else 4

#: Of a function that Python calls, without the interpreter lock; C does not.
OPTIONS: dict[str, Any] = {
    "fastmath": FASTMATH,
    "error_model": "numpy",
    "nogil": True,
    "no_cfunc_wrapper": True,
}

F = TypeVar("F", bound=Callable[..., Any])


class _Inlined(CPUDispatcher):
    """A function without an entry from Python: to jump there anyway would end the process."""

    def __call__(self, *_: Any, **__: Any) -> Any:
        raise TypeError(f"{self.py_func.__name__}: only compiled code can call it")


def inline(function: Callable[..., Any], *, checked: bool = False) -> Any:
    """Decorator of a function that becomes part of every compiled function that calls it.

    Nobody else can call it: entries from Python and C took more than half of its compilation.

    checked  an index beyond an array raises IndexError, as in Python; else it reads what is there
    """
    options = OPTIONS | {"forceinline": True, "no_cpython_wrapper": True}
    if checked:
        options["boundscheck"] = True
    dispatcher: Any = njit(**options)(function)
    dispatcher.__class__ = _Inlined
    return dispatcher


class _Compiling(Listener):
    """Sums the CPU seconds that compilations take, each thread's outermost ones."""

    def __init__(self) -> None:
        self.cpu_s = 0.0
        self._of_thread = threading.local()

    def on_start(self, event: Event) -> None:
        """A compilation begins, perhaps within another."""
        begun = self._of_thread.__dict__.setdefault("begun", [])
        begun.append(time.thread_time())

    def on_end(self, event: Event) -> None:
        """It ends."""
        begun_s = self._of_thread.begun.pop()
        if not self._of_thread.begun:
            self.cpu_s += time.thread_time() - begun_s


_COMPILING = _Compiling()
register("numba:compile", _COMPILING)  # type: ignore[no-untyped-call]


def computing_s() -> float:
    """CPU seconds of this process without compilation, which happens once on a computer."""
    return time.process_time() - _COMPILING.cpu_s


def hash_of(sources: Iterable[Path]) -> str:
    """Hash of what stands in some files, in the order of their names, and of how it is compiled."""
    digest = hashlib.sha256()
    for path in sorted([*sources, Path(__file__)]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def compiler(fingerprint: Callable[[], str]) -> Callable[[F], F]:
    """Decorator that compiles on first use, without the interpreter lock, and keeps it on disk.

    fingerprint  of all the sources that a compiled function may come from.  numba compares the
                 time stamp of the function's own file only, and so would run old code after a
                 change in a file that the function calls into; here the stamp is this fingerprint
    """

    def compiled(function: F) -> F:
        try:
            dispatcher: Any = njit(cache=True, **OPTIONS)(function)
        except RuntimeError:  # numba found no folder that it may write to
            return njit(**OPTIONS)(function)  # type: ignore[no-any-return]
        index = dispatcher._cache._cache_file
        index._source_stamp = fingerprint()
        # numba compares the stamp after it has read the rest, which may name types that are gone;
        # the version comes first
        index._version = f"{numba.__version__} {index._source_stamp}"
        return dispatcher  # type: ignore[no-any-return]

    return compiled


def _widest_vectors(typing_context: Any) -> Any:
    """Have the function that calls this use the widest vectors that the processor has.

    LLVM keeps to half of them, because they slow some processors' clocks; the engine's steps take
    a seventh less time with them.
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # llvmlite knows no such attribute, but writes what it is given
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), code


widest_vectors: Any = intrinsic(_widest_vectors)
