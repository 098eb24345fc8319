"""Starts emulators as processes of their own, and talks to their doors for faults."""

from __future__ import annotations

import json
import select
import socket
import subprocess
import sys
from typing import Any, Self

from drivers.emulators.ur_server import FAULT_PORT

_START_S = 20.0
_ANSWER_S = 5.0


class EmulatorError(RuntimeError):
    """An emulator did not start, or did not understand."""


class EmulatedController:
    """A UR controller on a loopback address, alive within a `with`."""

    def __init__(
        self,
        host: str,
        version: str = "5.12.2.1101534",
        model: str = "UR5e",
        time_scale: float = 1.0,
    ) -> None:
        self.host = host
        self._command = [sys.executable, "-m", "drivers.emulators.ur_server", "--host", host]
        self._command += ["--version", version, "--model", model, "--time-scale", str(time_scale)]
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        self._process = process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        ready, _, _ = select.select([process.stdout], [], [], _START_S)
        if not ready or process.stdout.readline().strip() != "ready":
            self.__exit__()
            raise EmulatorError(f"the emulated controller on {self.host} did not start")
        return self

    def __exit__(self, *_: object) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.communicate()  # closes its standard input, upon which it ends

    def ask(self, op: str, **arguments: Any) -> dict[str, Any]:
        """Cause a fault or ask for the `state`.  Raises EmulatorError: not understood."""
        with socket.create_connection((self.host, FAULT_PORT), _ANSWER_S) as door:
            door.sendall((json.dumps({"op": op, **arguments}) + "\n").encode())
            answer: dict[str, Any] = json.loads(door.makefile().readline())
        if "error" in answer:
            raise EmulatorError(f"{op}: {answer['error']}")
        return answer
