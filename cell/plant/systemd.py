"""Notifies systemd (sd_notify) of a service's states and watchdog, and writes its unit."""

from __future__ import annotations

import os
import re
import socket
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

#: Longest wait of an important message for a busy systemd, s; others do not wait.
_IMPORTANT_S = 1.0


def unit_of(config: Path, runs: Path, folder: Path, user: str) -> str:
    """Text of the systemd unit of a service.

    config, runs, folder  settings, records, and working folder of the service; absolute
    raises  ValueError: systemd rejects a path or the user; the message has the remedy
    """
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.-]*\$?|[0-9]+", user):
        raise ValueError(
            f"--user {user!r}: is no name of a user; give letters, digits, `_`, `.` and `-`"
        )
    for path in (config, runs, folder, Path(sys.executable)):
        if "\n" in str(path):
            raise ValueError(f"{str(path)!r}: systemd takes no path with a line break; rename it")
    if set(sys.executable) & set("\\\"'"):
        raise ValueError(
            f"{sys.executable}: systemd runs no program with a quote or a backslash in its path; "
            "make the environment in another folder"
        )
    template = files("cell.plant").joinpath("templates", "cable-cell.service").read_text("utf-8")
    return template.format(
        about=_literal(str(config)),
        config=_argument(str(config)),
        runs=_argument(str(runs)),
        folder=_literal(str(folder)),
        user=_literal(user),
        # systemd replaces variables in arguments, not in the path of the program
        program=_quoted(_literal(sys.executable)),
        python=_argument(sys.executable),
    ).rstrip()


def _literal(text: str) -> str:
    """Text in which systemd replaces nothing (systemd.unit(5), Specifiers)."""
    return text.replace("%", "%%")


def _quoted(text: str) -> str:
    """One word (systemd.syntax(7), Quoting)."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _argument(text: str) -> str:
    """One word of a command line (systemd.service(5), Command lines)."""
    return _quoted(_literal(text).replace("$", "$$"))


class Notifier:
    """Sends a service's states to systemd; without systemd it does nothing.

    environment  contains systemd's socket and the interval of its watchdog
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        interval_us = environment.get("WATCHDOG_USEC", "")
        is_ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(interval_us) * 1e-6 if is_ours and interval_us.isdigit() else None

    def ready(self) -> None:
        """The service accepts requests."""
        self._send("READY=1", _IMPORTANT_S)

    def status(self, words: str) -> None:
        """Text for `systemctl status`."""
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


#: A longer step means that the program hangs, s: the first one may compile.
LONGEST_STEP_S = 600.0
#: Longest time between two signs of life of a waiting service, s.
_WAITING_S = 5.0


class Watchdog:
    """Notifies systemd's watchdog as long as the thread that moves the cell makes progress."""

    def __init__(self) -> None:
        self.notifier = Notifier()
        self._until_s = float("inf")
        self._due_s = time.monotonic()

    def step(self) -> None:
        """An action begins that may last as long as a step."""
        self._until_s = time.monotonic() + LONGEST_STEP_S

    def waiting(self) -> None:
        """The service waits, and checks its commands."""
        self._until_s = time.monotonic() + _WAITING_S

    def notify(self, *, paused: bool) -> None:
        """Send a sign of life if it is due; called at short intervals.

        paused  the service waits for a person, for any time
        """
        watchdog_s, now_s = self.notifier.watchdog_s, time.monotonic()
        if watchdog_s is not None and (now_s < self._until_s or paused) and now_s >= self._due_s:
            self.notifier.alive()
            self._due_s = now_s + watchdog_s / 3.0
