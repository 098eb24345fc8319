"""How numerical functions are compiled, and when compiled code on disk is out of date."""

# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import gc
import hashlib
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numba
from llvmlite.binding import get_host_cpu_features
from numba import njit, types
from numba._dynfunc import make_function
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, _LowerResult
from numba.core.compiler_machinery import register_pass
from numba.core.event import Event, Listener, register
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering
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


def _with_room(function: Callable[..., Any], *args: Any) -> Any:
    """Call a function with room for the frames of deep recursion."""
    return function(*args)


# The interpreter asks the system for room for frames, and gives it back, 16 KB at a time: a
# recursion that goes back and forth over such an edge, as the compiler's does, spends a quarter of
# its time there.  This function asks for a megabyte at once.
_with_room.__code__ = _with_room.__code__.replace(co_stacksize=100_000)


class Entry(CPUDispatcher):
    """A function that Python can call, compiled once for all values of its arguments."""

    def compile(self, sig: Any) -> Any:
        """See `Dispatcher`; without garbage collection, which finds little in what is in use."""
        collected = gc.isenabled()
        gc.disable()
        try:
            return _with_room(super().compile, sig)
        finally:
            if collected:
                gc.enable()

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """See `Dispatcher`; a constant is a number as any other."""
        plain = {name: types.unliteral(kind) for name, kind in kws.items()}
        return super().get_call_template([types.unliteral(kind) for kind in args], plain)


class Part(Entry):
    """A function without an entry from Python: to jump there anyway would end the process."""

    def __call__(self, *_: Any, **__: Any) -> Any:
        """Python calls it.  Raises TypeError."""
        raise TypeError(f"{self.py_func.__name__}: only compiled code can call it")


class _PartCode(JITCodeLibrary):
    """Code that exists within others alone, where it is optimised and becomes machine code."""

    def _optimize_final_module(self) -> None:
        """Later, with the code that takes it in."""

    def _finalize_final_module(self) -> None:
        """Nothing is handed to the linker."""
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(NativeLowering):
    """Writes a function's code for others to take in."""

    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        """See `NativeLowering`."""
        context = state.targetctx
        state.library = _PartCode(context.codegen(), state.func_id.func_qualname)
        state.flags = state.flags.copy()
        state.flags.no_compile = True
        super().run_pass(state)
        function, env = state.cr.fndesc, state.cr.env
        # by it those that call the function know it; it jumps nowhere
        entry = make_function(function.lookup_module(), function.qualname, "", 0, env, ())
        context.insert_user_function(entry, function, [state.library])
        state.cr = _LowerResult(function, state.cr.call_helper, cfunc=entry, env=env)
        return True


class _PartCompiler(CompilerBase):
    """Compiles a function for others to take in."""

    def define_pipelines(self) -> list[Any]:
        """See `CompilerBase`."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [
            (_PartLowering, why) if a_pass is NativeLowering else (a_pass, why)
            for a_pass, why in passes.passes
        ]
        passes.finalize()
        return [passes]


def part(function: Callable[..., Any], **options: bool) -> Any:
    """Decorator of a function that is compiled within every compiled function that calls it.

    Nobody else can call it: machine code for each of them alone took half of all compilation.

    options  of numba
    """
    alone = {"no_cpython_wrapper": True, "pipeline_class": _PartCompiler}
    dispatcher: Any = njit(**OPTIONS | options | alone)(function)
    dispatcher.__class__ = Part
    return dispatcher


def inline(function: Callable[..., Any], *, checked: bool = False) -> Any:
    """Decorator of a small function: a `part` that is written out wherever it is called.

    checked  an index beyond an array raises IndexError, as in Python; else it reads that memory
    """
    options = {"forceinline": True} | ({"boundscheck": True} if checked else {})
    return part(function, **options)


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
register("numba:compile", _COMPILING)


def computing_s() -> float:
    """CPU seconds of this process without compilation, which happens once on a computer."""
    return time.process_time() - _COMPILING.cpu_s


def is_to_be_compiled(function: Any) -> bool:
    """Whether no code of a compiled function is on the disk, where another process can leave it."""
    cache = function._cache
    return not isinstance(cache, NullCache) and not cache._cache_file._load_index()


def hash_of(sources: Iterable[Path]) -> str:
    """Hash of the contents of files, in the order of their names, and of the compiler options."""
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
        dispatcher: Any = njit(**OPTIONS)(function)
        dispatcher.__class__ = Entry
        try:
            dispatcher.enable_caching()
        except RuntimeError:  # there is no folder that numba may write to
            return dispatcher  # type: ignore[no-any-return]
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
        # llvmlite knows no such attribute, but writes any text
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), code


widest_vectors: Any = intrinsic(_widest_vectors)
