"""A user's own effect is first tried in a process of its own, which can be killed.

A loop without end in compiled code hears neither Ctrl-C nor a clock of Python; and what ends the
process, or takes all memory, ends only that one.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType

from cell.cable.effects.base import EffectError
from cell.computer.watched import PATIENCE_S, POLL_S, GrantedTime, RunningCall, no_end

#: Time that compiling the hooks may take, s; and the process's own beginning.
COMPILING_S = 120.0
#: Memory that it may take, bytes; numba's libraries are mapped into most of it.
MEMORY_BYTES = 6 * 1024**3


def try_effect(file: Path, load: Callable[[Path, Callable[[str, int, float], None]], None]) -> None:
    """Run `load(file, doing)` elsewhere; it calls `doing(next task, line, seconds allowed)`.

    Time in which others have the cores counts as in `cell.computer.watched`.

    raises  EffectError: that of `load`, or what ended the process, with what was done then
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["cell.cable.effects.library"])
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_try, args=(file, load, sender), daemon=True)
    with _without_main():
        process.start()
    sender.close()
    what, line, patience_s = "its module", 1, COMPILING_S
    granted, under_way = GrantedTime(process.pid or 0), RunningCall()
    try:
        while not under_way.is_stuck(patience_s):
            if not receiver.poll(POLL_S):
                under_way.sample(granted.since_last_sample_s())
                continue
            kind, text, at, patience_s = receiver.recv()
            if kind == "right":
                return
            if kind == "refused":
                raise EffectError(file, at, text)
            what, line, under_way = text, at, RunningCall()
        cause = no_end(patience_s)
    except EOFError:
        cause = "ends the process: mend that"
    finally:
        process.kill()
        process.join()
        receiver.close()
    raise EffectError(file, line, f"{what} {cause}")


@contextmanager
def _without_main() -> Iterator[None]:
    """Whatever is started during it does not run the caller's script once more.

    Python's own starter would, for pickles of its names; none is sent here.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def limit_memory() -> None:
    """Let this process take so much memory at most, or less where less is allowed already.

    The hard limit stays: nobody but root may raise one.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(MEMORY_BYTES, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))


def _try(
    file: Path, load: Callable[[Path, Callable[[str, int, float], None]], None], to: Connection
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who listens ends this process
    limit_memory()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def doing(what: str, line: int, seconds: float) -> None:
        """Tell it; who listens ends this process when the seconds are over."""
        to.send(("doing", what, line, seconds))

    try:
        doing("its module", 1, PATIENCE_S)
        load(file, doing)
        to.send(("right", "", 0, 0))
    except EffectError as error:
        to.send(("refused", error.cause, error.line, 0))
    except MemoryError:
        to.send(("refused", f"takes more than {MEMORY_BYTES / 1024**3:g} GiB", 1, 0))
    finally:
        with contextlib.suppress(OSError):
            to.close()
