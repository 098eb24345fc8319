"""Processes that a study starts: output, ports, end and CPU time."""

from __future__ import annotations

import os
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

#: Time limit for the start of a program, s: on a new computer it compiles.
BEGIN_S = 180.0


def free_port() -> int:
    """A free port of loopback."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


class Program:
    """A process whose output is kept; `options` of `Popen`."""

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        self.command = command
        self._log = tempfile.TemporaryFile()  # noqa: SIM115, closed with this
        self.process = subprocess.Popen(
            command, stdout=self._log, stderr=subprocess.STDOUT, **options
        )

    @property
    def output(self) -> str:
        """Its output so far."""
        size = os.fstat(self._log.fileno()).st_size
        return os.pread(self._log.fileno(), size, 0).decode(errors="replace")

    def until(self, text: str) -> None:
        """Wait for a text in its output.  Raises RuntimeError: it has ended, or timed out."""
        wait_until(lambda: text in self.output, self)

    def end(self) -> None:
        """Kill it; its output is lost."""
        self.process.kill()
        self.process.wait()
        self._log.close()


def wait_until(reached: Callable[[], bool], program: Program | None = None) -> None:
    """Wait for a condition.  Raises RuntimeError: a program has ended, or it takes too long."""
    until_s = time.monotonic() + BEGIN_S
    while not reached():
        ended = program is not None and program.process.poll() is not None
        if ended or time.monotonic() > until_s:
            raise RuntimeError(
                "the plant does not begin"
                if program is None
                else f"{' '.join(program.command)}: {program.output}"
            )
        time.sleep(0.02)


@contextmanager
def going_on(task: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run a task in a thread within the `with`; its event requests the end."""
    over = threading.Event()
    thread = threading.Thread(target=task, args=(over,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(60.0)


def listens(port: int) -> bool:
    """Whether a process listens at a port of loopback."""
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def running(*words: str, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run a Python module as a process within the `with`; its output goes to a file.

    raises  RuntimeError: it ends with an error
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as output:
        process = subprocess.Popen([sys.executable, "-m", *words], stdout=output, stderr=output)
    try:
        yield process
        process.terminate()
        if process.wait(60.0) != 0:
            raise RuntimeError(f"{words[:2]} ended with {process.returncode}; see {log}")
    finally:
        process.kill()
        process.wait()


@contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """Run `count` processes that each keep a core busy."""
    command = [sys.executable, "-c", "while True: pass"]
    busy = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def family(process: int) -> list[int]:
    """A process and all its descendants, by /proc."""
    processes = [process]
    for parent in processes:
        for file in Path(f"/proc/{parent}/task").glob("*/children"):
            with suppress(OSError):  # it has ended
                processes += map(int, file.read_text().split())
    return processes


def status_of(process: int) -> dict[str, str]:
    """Its /proc/…/status by field, such as `VmRSS`; empty = it has ended."""
    with suppress(OSError):
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        return dict(line.split(":", 1) for line in lines)
    return {}


def own_cpu_s() -> float:
    """CPU time of this process and of its ended children, s."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)
