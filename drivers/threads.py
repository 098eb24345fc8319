"""Threads that pass on an uncaught exception and log it, instead of ending silently."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Callable

_LOG = logging.getLogger(__name__)


class GuardedThread(threading.Thread):
    """A daemon thread that does not die silently.

    Python prints an uncaught exception of a thread, and the program goes on without its work.
    The starter of a thread therefore states the consequence: a stop, or a named degradation.

    name      of the thread, for the log
    work      function of the thread
    on_death  called with the exception that ended `work`, in this thread, before it is logged
    """

    def __init__(
        self, name: str, work: Callable[[], None], on_death: Callable[[BaseException], None]
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._work = work
        self._on_death = on_death

    def run(self) -> None:
        """See `threading.Thread`."""
        try:
            self._work()
        except BaseException as error:
            try:
                self._on_death(error)
            finally:
                _LOG.error(
                    "the thread %s has ended: %s", self.name, error_text(error), exc_info=error
                )


def error_text(error: BaseException) -> str:
    """Type and message of an exception."""
    return f"{type(error).__name__}: {error}"


def only_logged(error: BaseException) -> None:
    """Handler for a thread on which nothing depends: the exception is only logged."""


def end_process(error: BaseException) -> None:
    """Handler for a thread that its process needs: log the exception and end the process."""
    _LOG.error("%s", error_text(error), exc_info=error)
    with contextlib.suppress(OSError):  # where nothing is logged, the process does not end silently
        os.write(2, f"this process ends: {error_text(error)}\n".encode())
    os._exit(1)
