"""Client of a UR controller's dashboard server, without ur-rtde, with short timeouts."""

from __future__ import annotations

import socket
import threading
import time

from drivers.rtde_wire import DASHBOARD_PORT
from drivers.threads import GuardedThread, error_text

_EVERY_S = 0.5


class Dashboard:
    """A connection to the dashboard server of a controller.

    seconds  that connecting or an answer may take
    raises   OSError: it does not exist or answer
    """

    def __init__(self, host: str, seconds: float = 2.0) -> None:
        self._socket = socket.create_connection((host, DASHBOARD_PORT), seconds)
        self._lines = self._socket.makefile("rw", encoding="utf-8", errors="replace", newline="\n")
        try:
            self._line()  # its greeting
        except OSError:
            self.close()
            raise

    def request(self, command: str) -> str:
        """The answer to a command.  Raises OSError; the connection is then of no more use."""
        self._lines.write(command + "\n")
        self._lines.flush()
        return self._line()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def _line(self) -> str:
        line = self._lines.readline()
        if not line:
            raise ConnectionError("the dashboard has closed the connection")
        return line.strip()


class RemoteControl:
    """Polls twice a second, in a thread, whether the controller is in remote control.

    While the pendant has control a controller takes no program, but goes on with the one that runs.

    is_remote  newest answer of the controller
    unknown    why polling has ended; "" = it goes on
    raises     OSError: the dashboard does not answer
    """

    def __init__(self, host: str) -> None:
        self.is_remote = True
        self.unknown = ""
        self._host = host
        self._lock = threading.Lock()
        self._dashboard = Dashboard(host)
        self.request()
        self._thread = GuardedThread("remote control", self._watch, self._died)

    def begin(self) -> None:
        """Start polling."""
        self._thread.start()

    def request(self) -> None:
        """Poll now, over a new connection if the old one is broken.  Raises OSError."""
        with self._lock:
            try:
                answer = self._dashboard.request("is in remote control")
            except OSError:
                self._dashboard.close()
                self._dashboard = Dashboard(self._host)
                answer = self._dashboard.request("is in remote control")
            self.is_remote = answer != "false"

    def _watch(self) -> None:
        while True:
            time.sleep(_EVERY_S)
            self.request()

    def _died(self, error: BaseException) -> None:
        self.unknown = f"the dashboard does not tell who has control: {error_text(error)}"
