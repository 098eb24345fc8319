"""`python -m cell` in a process of its own that need not load its modules first.

Importing them takes a process more of the processor's time than all that a short run does then.
One process has imported them, in which nothing has begun; each command is a fork of it.  Signals,
what is printed, and how it ends are those of any process.
"""

from __future__ import annotations

import importlib
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).parents[2]
#: What a run and a service import sooner or later.
MODULES = (
    *(
        "cell.wiring.build",
        "cell.cli",
        "cell.cli.cell_factory",
        "cell.lab.next",
    ),
    *("cell.plant.children", "cell.plant.server", "cell.plant.service", "cell.plant.systemd"),
    "cell.records.model_errors",
    *("cell.run.computer_check", "cell.cli.keyboard", "cell.cli.cycle_tables"),
)
#: So long a process may take until it has begun, or until it is gone after a kill, s.
LONGEST_S = 60.0


class Forked:
    """A command under way; used as a `subprocess.Popen` is, and never waited for without end."""

    def __init__(self, told: int, out: IO[bytes], err: IO[bytes]) -> None:
        self._told, self._files = told, (out, err)
        self._begun, self._said = b"", (b"", b"")
        self.returncode: int | None = None
        self.pid = int(self._line(LONGEST_S))

    def _line(self, seconds: float) -> bytes:
        """What is said next of the process; raises TimeoutExpired."""
        until_s = time.monotonic() + seconds
        while b"\n" not in self._begun:
            left_s = max(0.0, until_s - time.monotonic())
            if not select.select([self._told], [], [], left_s)[0]:
                raise subprocess.TimeoutExpired("cell", seconds)
            more = os.read(self._told, 100)
            assert more, "whoever forks has ended"
            self._begun += more
        line, _, self._begun = self._begun.partition(b"\n")
        return line

    def wait(self, timeout: float = LONGEST_S) -> int:
        if self.returncode is None:
            self.returncode = int(self._line(timeout))
            os.close(self._told)
            self._said = (_whole(self._files[0]), _whole(self._files[1]))
        return self.returncode

    def poll(self) -> int | None:
        try:
            return self.wait(0.0)
        except subprocess.TimeoutExpired:
            return None

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float = LONGEST_S) -> tuple[bytes, bytes]:
        """All that it printed, when it has ended."""
        self.wait(timeout)
        return self._said


def _whole(file: IO[bytes]) -> bytes:
    with file:
        file.seek(0)
        return file.read()


class Forking:
    """The process that has imported all; alive within a `with`."""

    def __enter__(self) -> Forking:
        self._door, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.end_to_end.forked"], cwd=ROOT, stdin=theirs
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._door.close()  # upon which it ends
        self._process.wait(LONGEST_S)

    def start(
        self, *words: object, environment: Mapping[str, str] | None = None, first: str = ""
    ) -> Forked:
        """Begin `cell words`, with nobody at its standard input.

        environment   beside our own
        first         a program that the process runs before it opens its standard streams
        """
        told, tell = os.pipe()
        out, err = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115  # see Forked
        wanted = {
            "words": [str(word) for word in words],
            "folder": os.getcwd(),  # noqa: PTH109  # a path as it is
            "first": first,
            "environment": dict(os.environ) | dict(environment or {}),
        }
        socket.send_fds(
            self._door, [json.dumps(wanted).encode()], [tell, out.fileno(), err.fileno()]
        )
        os.close(tell)
        return Forked(told, out, err)


def _serve(door: socket.socket) -> dict[str, Any] | None:
    """Fork for each request; returns in the fork with what it shall do, here when nobody asks."""
    while True:
        text, fds, _, _ = socket.recv_fds(door, 1_000_000, 3)
        if not text:
            return None
        keeper = os.fork()
        if keeper == 0:
            break
        for fd in fds:
            os.close(fd)
        _reap()
    tell, out, err = fds
    child = os.fork()
    if child == 0:
        nobody = os.open(os.devnull, os.O_RDONLY)
        for fd, place in ((nobody, 0), (out, 1), (err, 2)):
            os.dup2(fd, place)
        os.closerange(3, max(*fds, nobody) + 1)
        wanted: dict[str, Any] = json.loads(text)
        return wanted
    os.write(tell, b"%d\n" % child)
    status = os.waitpid(child, 0)[1]
    os.write(tell, b"%d\n" % os.waitstatus_to_exitcode(status))
    os._exit(0)


def _reap() -> None:
    """Take notice of those that have ended."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        pass


def main() -> None:
    for name in MODULES:
        importlib.import_module(name)
    assert len(os.listdir("/proc/self/task")) == 1, "a fork has one thread only"  # noqa: PTH208
    door = socket.socket(fileno=os.dup(0))
    wanted = _serve(door)
    if wanted is None:
        return
    os.environ.clear()
    os.environ.update(wanted["environment"])
    os.chdir(wanted["folder"])
    exec(wanted["first"], {})
    for name, mode, fd in (("stdin", "r", 0), ("stdout", "w", 1), ("stderr", "w", 2)):
        setattr(sys, name, open(fd, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
    sys.argv[1:] = wanted["words"]
    runpy.run_module("cell", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
