"""A user's own effect is first tried in a process of its own, which can be killed.

A loop without end in compiled code hears neither Ctrl-C nor a clock of Python; and what ends the
process, or takes all memory, ends only that one.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

from cell.cable.effects.refused import EffectError

#: Computing that one step of the trial may take, s: a hook takes microseconds.
STEP_S = 4
#: The same of compiling the hooks.
COMPILING_S = 60
#: Time in which a step must end even if it only sleeps, s.
PATIENCE_S = 120.0
#: Memory that it may take, bytes; numba's libraries are mapped into most of it.
MEMORY_BYTES = 6 * 1024**3


def try_effect(file: Path, load: Callable[[Path, Callable[[str, int, int], None]], None]) -> None:
    """Run `load(file, doing)` elsewhere; `doing` is told what comes next, its line, seconds for it.

    raises  EffectError: that of `load`, or what ended the process, with what was done then
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["cell.cable.effects.library"])
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_try, args=(file, load, sender), daemon=True)
    process.start()
    sender.close()
    what, line = "its module", 1
    cause = f"does not end within {PATIENCE_S:g} s"
    try:
        while receiver.poll(PATIENCE_S):
            kind, text, at = receiver.recv()
            if kind == "right":
                return
            if kind == "refused":
                raise EffectError(file, at, text)
            what, line = text, at
    except EOFError:
        process.join()
        cause = "takes too long, as a loop without end does, or ends the process: mend that"
    finally:
        process.kill()
        process.join()
        receiver.close()
    raise EffectError(file, line, f"{what} {cause}")


def _try(
    file: Path, load: Callable[[Path, Callable[[str, int, int], None]], None], to: Connection
) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def doing(what: str, line: int, seconds: int) -> None:
        """Tell it, and have the system end this process if it computes for longer."""
        used = resource.getrusage(resource.RUSAGE_SELF)
        limit = int(used.ru_utime + used.ru_stime) + 1 + seconds
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
        to.send(("doing", what, line))

    try:
        doing("its module", 1, STEP_S)
        load(file, doing)
        to.send(("right", "", 0))
    except EffectError as error:
        to.send(("refused", error.cause, error.line))
    except MemoryError:
        to.send(("refused", f"takes more than {MEMORY_BYTES / 1024**3:g} GiB", 1))
    finally:
        with contextlib.suppress(OSError):
            to.close()
