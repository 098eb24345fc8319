"""Trial of a user's own effect in a process of its own, which can be killed.

An endless loop in compiled code reacts neither to Ctrl-C nor to a Python timer; a crash, or lack of
memory, ends only that process.
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

#: Time limit of compiling the hooks, s, and of the process's start.
COMPILING_S = 120.0
#: Memory that it may take, bytes; numba's libraries are mapped into most of it.
MEMORY_BYTES = 6 * 1024**3


def try_effect(file: Path, load: Callable[[Path, Callable[[str, int, float], None]], None]) -> None:
    """Run `load(file, doing)` elsewhere; it calls `doing(next task, line, seconds allowed)`.

    Time limits allow for other load on the cores as in `cell.computer.watched`.

    raises  EffectError: that of `load`, or the cause of the process's end and its last task
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
    """Context in which a started process does not run the caller's script again.

    multiprocessing would, to unpickle its names; none are sent here.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def limit_memory() -> None:
    """Limit the memory of this process to `MEMORY_BYTES`, or to its lower hard limit.

    The hard limit is not changed: only root may raise it again.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(MEMORY_BYTES, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))


def _try(
    file: Path, load: Callable[[Path, Callable[[str, int, float], None]], None], to: Connection
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    limit_memory()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def doing(what: str, line: int, seconds: float) -> None:
        """Report the next task; the parent ends this process after these seconds."""
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
