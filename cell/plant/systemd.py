"""What a service tells systemd, by its own protocol (sd_notify): datagrams to a Unix socket."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

#: What must not be lost waits so long for a systemd that is busy, s; the rest does not wait.
_IMPORTANT_S = 1.0


class Notifier:
    """Tells systemd how a service does; without systemd it does nothing.

    environment  in which systemd names its socket, and within what time it wants signs of life
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        wanted = environment.get("WATCHDOG_USEC", "")
        meant = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(wanted) * 1e-6 if meant and wanted.isdigit() else None

    def ready(self) -> None:
        """The service takes requests."""
        self._send("READY=1", _IMPORTANT_S)

    def status(self, words: str) -> None:
        """What `systemctl status` shows."""
        self._send(f"STATUS={words}")

    def alive(self) -> None:
        """A sign of life."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The service is about to end."""
        self._send("STOPPING=1", _IMPORTANT_S)

    def _send(self, text: str, wait_s: float = 0.0) -> None:
        if not self._address:
            return
        address = "\0" + self._address[1:] if self._address[0] == "@" else self._address
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as to:
            to.settimeout(wait_s)
            to.sendto(text.replace("\n", " ").encode(), address)
