"""Lines that somebody types while a command works."""

from __future__ import annotations

import os
import select
import sys
import time


class TypedLines:
    """Lines of standard input as they come, without waiting for its end.

    A process in the background of a terminal reads nothing, because that would halt it.
    """

    def __init__(self) -> None:
        self._begun = b""
        try:
            self._descriptor = -1 if sys.stdin is None else sys.stdin.fileno()
        except (OSError, ValueError):
            self._descriptor = -1

    def within(self, seconds: float) -> list[str]:
        """Those that come within a time, without the blanks around them; empty ones are left out.

        It returns with the first that comes.
        """
        if self._descriptor < 0 or not self._is_ours():
            time.sleep(seconds)
            return []
        if not select.select([self._descriptor], [], [], seconds)[0]:
            return []
        try:
            new = os.read(self._descriptor, 4096)
        except OSError:
            new = b""
        if not new:  # it has ended, or the terminal is gone
            self._descriptor = -1
        *lines, self._begun = (self._begun + new).split(b"\n")
        words = (line.decode(errors="replace").strip() for line in lines)
        return [w for w in words if w]

    def _is_ours(self) -> bool:
        if not os.isatty(self._descriptor):
            return True
        try:
            return os.tcgetpgrp(self._descriptor) == os.getpgrp()
        except OSError:
            return False
