"""Keys that a person presses at the terminal while a command works."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable
from typing import Any

from cell.cli.streams import is_in_foreground
from cell.run.machine import MachineEvent
from drivers.threads import GuardedThread, error_text

#: Keys of a run: what each does, and the hint that is shown then.
MAY_HOLD = "h: hold"
KEYS = {
    "h": (MachineEvent.HOLD, "holding; u: go on"),
    "u": (MachineEvent.UNHOLD, MAY_HOLD),
}
#: Keys are dropped if this process was halted for longer before it could read them, s.
_OLDEST_S = 1.0
#: Interval of the check whether the terminal is ours again, s.
_LOOK_S = 0.2


class Keyboard:
    """Calls `on_key` for every key pressed, in a thread, within a `with`.

    Keys come without Enter and are not shown; Ctrl-C stays what it is.  Without a terminal, or in
    the background, nothing is read: `listens` is False.
    """

    def __init__(self, on_key: Callable[[str], None]) -> None:
        self._on_key = on_key
        self._former: list[Any] | None = None
        self._descriptor = -1
        self._over = threading.Event()
        self._thread = GuardedThread("keyboard", self._listen, _unread)

    @property
    def listens(self) -> bool:
        """Whether keys are read."""
        return self._former is not None

    def __enter__(self) -> Keyboard:
        try:
            self._descriptor = sys.stdin.fileno()
            if is_in_foreground(self._descriptor):
                self._former = termios.tcgetattr(self._descriptor)
                tty.setcbreak(self._descriptor)
                self._thread.start()
        except (OSError, ValueError, AttributeError, termios.error):
            self._former = None  # standard input is no terminal, or closed
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._former is not None:
            self._thread.join()
            if is_in_foreground(self._descriptor):
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._former)
            self._former = None

    def _listen(self) -> None:
        while not self._over.is_set():
            looked_s = time.monotonic()
            ready, _, _ = select.select([self._descriptor], [], [], _LOOK_S)
            if not ready:
                continue
            if not is_in_foreground(self._descriptor):
                self._over.wait(_LOOK_S)
                continue
            try:
                keys = os.read(self._descriptor, 64)
            except OSError:
                return
            if not keys:  # the terminal has gone
                return
            if time.monotonic() - looked_s > _OLDEST_S:
                continue
            for key in keys.decode(errors="replace"):
                self._on_key(key)


def _unread(error: BaseException) -> None:
    print(f"keys are read no more: {error_text(error)}; Ctrl-C still stops", file=sys.stderr)
