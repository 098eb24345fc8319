"""Starts emulators as processes, and sends them faults over connections called doors."""

from __future__ import annotations

import json
import multiprocessing
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Self

from drivers.interfaces import FloatArray
from drivers.rtde_wire import FAULT_PORT

_START_S = 120.0  # on a new computer the machine code is compiled first, a minute on a busy one
_ANSWER_S = 5.0


class EmulatorError(RuntimeError):
    """An emulator did not start, or rejected a request."""


class EmulatedController:
    """A UR controller on a loopback address, alive within a `with`.

    start_rad  (6,) initial joints of the arm; None = a default
    """

    def __init__(
        self,
        host: str,
        version: str = "5.12.2.1101534",
        model: str = "UR5e",
        time_scale: float = 1.0,
        start_rad: FloatArray | None = None,
    ) -> None:
        self.host = host
        self.version = version
        self._command = [sys.executable, "-m", "drivers.emulators.ur_server", "--host", host]
        self._command += ["--version", version, "--model", model, "--time-scale", str(time_scale)]
        if start_rad is not None:
            self._command += ["--start-rad=" + ",".join(f"{q:.12g}" for q in start_rad)]
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        self._process = process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C goes to its parent, which then ends it
        )
        assert process.stdout is not None
        ready, _, _ = select.select([process.stdout], [], [], _START_S)
        line = process.stdout.readline().strip() if ready else f"says nothing within {_START_S:g} s"
        if line != "ready":
            self.__exit__()
            raise EmulatorError(f"the emulated controller on {self.host} {line or 'did not start'}")
        return self

    def __exit__(self, *_: object) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.communicate()  # closes its standard input, upon which it ends

    @property
    def pid(self) -> int | None:
        """Process, for those who want to kill it."""
        return None if self._process is None else self._process.pid

    @property
    def alive(self) -> bool:
        """Whether its process has not ended."""
        return self._process is not None and self._process.poll() is None

    def request(self, op: str, **arguments: Any) -> dict[str, Any]:
        """Cause a fault or ask for the `state`.  Raises EmulatorError: not understood."""
        with socket.create_connection((self.host, FAULT_PORT), _ANSWER_S) as door:
            door.sendall((json.dumps({"op": op, **arguments}) + "\n").encode())
            answer: dict[str, Any] = json.loads(door.makefile().readline())
        if "error" in answer:
            raise EmulatorError(f"{op}: {answer['error']}")
        return answer


class EmulatorProcess:
    """An emulator in a process of its own, alive within a `with`; it ends when its parent does.

    name   in messages: "camera"
    serve  called in that process, with its end of a pipe and `args`; first sends the argument of
           `started`, then answers with `serve_requests`
    """

    def __init__(self, name: str, serve: Callable[..., None], args: tuple[object, ...]) -> None:
        self._name = name
        self._serve = serve
        self._args = args
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        context = multiprocessing.get_context("spawn")
        self._door, theirs = context.Pipe()
        self._process = context.Process(
            target=self._serve, args=(theirs, *self._args), daemon=True, name=self._name
        )
        self._process.start()
        theirs.close()
        try:
            self.started(self._answer(_START_S))
        except EmulatorError:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._door.close()  # upon which it ends
        self._process.join(_ANSWER_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    @property
    def pid(self) -> int | None:
        """Process, for those who want to kill it."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether its process has not ended."""
        return self._process.is_alive()

    def started(self, value: Any) -> None:
        """Process the value that the process sent when it was ready."""

    def request(self, name: str, content: object = None) -> Any:
        """Send a request from any thread.  Raises EmulatorError: it is gone, or refused."""
        with self._lock:
            try:
                self._door.send((name, content))
            except OSError as error:
                raise EmulatorError(f"the emulated {self._name} is gone") from error
            return self._answer(_ANSWER_S)

    def _answer(self, wait_s: float) -> Any:
        try:
            if not self._door.poll(wait_s):
                raise EmulatorError(f"the emulated {self._name} did not answer within {wait_s} s")
            done, answer = self._door.recv()
        except (EOFError, OSError) as error:
            raise EmulatorError(f"the emulated {self._name} is gone") from error
        if not done:
            raise EmulatorError(f"the emulated {self._name}: {answer}")
        return answer


def leave_interrupts_to_parent() -> None:
    """Ignore Ctrl-C and a closed terminal: the parent stops the cell, then ends this process."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


def serve_requests(door: Connection, serve: Callable[[str, Any], object]) -> None:
    """Serve the parent's requests; end this process when the connection is closed."""
    try:
        while True:
            answer: tuple[bool, object]
            name, content = door.recv()
            try:
                answer = True, serve(name, content)
            except Exception as error:
                answer = False, f"{type(error).__name__}: {error}"
            door.send(answer)
    except (EOFError, OSError):
        os._exit(0)
