"""The parent's handle of the process that runs ur-rtde: starts it, receives from it, ends it."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import BinaryIO

from drivers.ur_child import ChildOptions
from drivers.ur_shared import SIZE_BYTES, SharedState


@dataclass
class ChildProcess:
    """A running child process and the two ways to it."""

    process: subprocess.Popen[bytes]
    connection: Connection
    shared: SharedState
    errors: BinaryIO

    def last_words(self) -> str:
        """Last line that ur-rtde printed."""
        self.errors.seek(0)
        lines = self.errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else "no message"

    def end(self) -> None:
        """Kill it if it still runs, and release all resources."""
        self.process.kill()
        self.process.wait()
        self.connection.close()
        self.errors.close()

    def farewell(self) -> str:
        """Why it ended: its last message, or its exit code."""
        with contextlib.suppress(EOFError, OSError):
            while self.connection.poll(0):
                answer = self.connection.recv()
                if answer[0] == "lost":
                    return str(answer[1])
        if self.process.returncode == -signal.SIGXCPU:  # see priority.bound_spinning
            return "ur-rtde waited for an answer of the controller for too long"
        return f"the arm's process ended ({self.process.returncode}): {self.last_words()}"


def start_child(options: ChildOptions) -> ChildProcess:
    """Start `drivers.ur_child` with memory that both sides share."""
    ours, theirs = Pipe()
    with tempfile.TemporaryFile() as memory:
        memory.truncate(SIZE_BYTES)
        shared = SharedState(memory.fileno())
        errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the child
        numbers = [theirs.fileno(), memory.fileno()]
        process = subprocess.Popen(
            [sys.executable, "-m", "drivers.ur_child", *map(str, numbers)],
            pass_fds=numbers,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,  # signals of the terminal go to the parent
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
    theirs.close()
    ours.send_bytes(pickle.dumps(options))
    return ChildProcess(process, ours, shared, errors)
