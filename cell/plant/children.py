"""Keeps the service's adapters running: each is a process, restarted when it ends.

python -m cell.plant.children PARENT WORDS … is `cell WORDS …` as a child of the process PARENT, at
lower priority; it ends with its parent.
"""

from __future__ import annotations

import logging
import os
import runpy
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from cell.computer.forks import end_with_parent
from drivers.threads import GuardedThread, error_text

_LOG = logging.getLogger(__name__)

#: An adapter that has ended is started again after the first pause, then twice as long, up to the
#: longest, s.
FIRST_S, LONGEST_S = 1.0, 60.0
#: Time after which a restarted adapter counts as running again, s.
WELL_S = 60.0
#: Time for adapters to read the last notices, s.
TAKE_S = 0.5
#: Time for adapters to end after SIGTERM, s.
END_S = 3.0
#: Of adapters, against -10 of a cell with real devices; a PLC is still answered in time.
NICE = 10


def command_of(adapter: str, config: Path, runs: Path) -> list[str]:
    """Command line that runs an adapter as a child of this process."""
    child = [sys.executable, "-m", "cell.plant.children", str(os.getpid())]
    return [*child, adapter, "--config", str(config), "--runs", str(runs)]


class Adapters:
    """Keeps adapters running from `start` to `close`; only `close` waits for them.

    commands    of each, by its name
    on_trouble  called from other threads with name and trouble of an adapter; empty = none now
    """

    def __init__(
        self, commands: Mapping[str, Sequence[str]], on_trouble: Callable[[str, str], None]
    ) -> None:
        over = threading.Event()
        self._adapters = [_SupervisedAdapter(*c, on_trouble, over) for c in commands.items()]
        self._over = over

    def start(self) -> None:
        """Begin."""
        for adapter in self._adapters:
            adapter.start()

    def close(self) -> None:
        """End all adapters; close the cell's link first, so that they have every notice."""
        started = [adapter for adapter in self._adapters if adapter.is_alive()]
        if started:
            time.sleep(TAKE_S)
        self._over.set()
        until_s = time.monotonic() + END_S
        with ExitStack() as ended:
            for adapter in started:
                adapter.terminate()
                ended.callback(adapter.end, until_s)


class _SupervisedAdapter(GuardedThread):
    """One adapter: a thread that starts it and waits for its end.

    Linux ends the child with the thread that started it, so this one lives as long.
    """

    def __init__(
        self,
        adapter: str,
        command: Sequence[str],
        on_trouble: Callable[[str, str], None],
        over: threading.Event,
    ) -> None:
        super().__init__(f"adapter {adapter}", self._restart_loop, self._died)
        self._adapter = adapter
        self._command = command
        self._on_trouble = on_trouble
        self._over = over
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._troubled = False

    def _died(self, error: BaseException) -> None:
        self._report(
            f"has ended, and is not started again: {error_text(error)}; restart the service"
        )

    def _restart_loop(self) -> None:
        pause_s = FIRST_S
        while not self._over.is_set():
            trouble, lived_s = self._run_once()
            if self._over.is_set():
                return
            if lived_s >= WELL_S:
                pause_s = FIRST_S
            if not self._troubled:
                self._report(f"has ended: {trouble}; it is started again, at least every minute")
            self._over.wait(pause_s)
            pause_s = min(2.0 * pause_s, LONGEST_S)

    def _run_once(self) -> tuple[str, float]:
        """Run it: why it ended, and how long it lived, s."""
        begun_s = time.monotonic()
        with self._lock:
            if self._over.is_set():
                return "", 0.0
            try:
                # Ctrl-C is not for it, and the service's standard output has results only
                self._process = process = subprocess.Popen(
                    self._command, stdin=subprocess.DEVNULL, stdout=2, process_group=0
                )
            except OSError as error:
                return str(error), 0.0
        if self._troubled:
            with suppress(subprocess.TimeoutExpired):
                process.wait(WELL_S)
            if process.returncode is None:
                self._report("")
        code = process.wait()
        return f"exit code {code}" if code >= 0 else f"signal {-code}", time.monotonic() - begun_s

    def _report(self, trouble: str) -> None:
        self._troubled = bool(trouble)
        _LOG.warning("adapter %s %s", self._adapter, trouble or "runs again")
        self._on_trouble(self._adapter, trouble)

    def terminate(self) -> None:
        """Send SIGTERM."""
        with self._lock:
            if self._process is not None and self._process.returncode is None:
                self._process.terminate()

    def end(self, until_s: float) -> None:
        """Wait for its end until then, on the monotonic clock; afterwards it is killed."""
        self.join(max(0.0, until_s - time.monotonic()))
        if self.is_alive() and self._process is not None:
            _LOG.warning("adapter %s does not end: it is killed", self._adapter)
            self._process.kill()
            self.join(END_S)


def main() -> None:
    """Replace this process by the `cell` command in its arguments."""
    parent, *words = sys.argv[1:]
    end_with_parent(int(parent))
    with suppress(AttributeError, OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    sys.argv = ["cell", *words]
    runpy.run_module("cell", run_name="__main__")


if __name__ == "__main__":
    main()
