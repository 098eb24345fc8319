"""Sets up logging in one place: a rotating file, and the error stream on `--verbose`.

Every module logs to `logging.getLogger(__name__)`; nothing else knows where that goes.
"""

from __future__ import annotations

import contextlib
import logging
import platform
import sys
from importlib.metadata import version
from logging.handlers import RotatingFileHandler
from pathlib import Path

#: Packages whose messages are ours.
PACKAGES = ("cell", "drivers", "calib")
#: Size at which a file is closed and numbered, bytes, and number of stored old files.
FILE_BYTES, OLD_FILES = 2_000_000, 5
_FORM = "%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s"
_TIME = "%Y-%m-%d %H:%M:%S"


class _LogFile(RotatingFileHandler):
    """A rotating file that never disturbs the work: a write error is reported once."""

    _reported = False

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's own name
        if not self._reported:
            self._reported = True
            print(f"the log cannot be written: {sys.exc_info()[1]}", file=sys.stderr)


def to_terminal(*, verbose: bool) -> None:
    """Log to the error stream: everything if `verbose`, else nothing."""
    _remove(logging.StreamHandler)
    _remove(logging.NullHandler)
    handler: logging.Handler = logging.StreamHandler() if verbose else logging.NullHandler()
    handler.setFormatter(logging.Formatter(_FORM, _TIME))
    _add(handler, logging.DEBUG if verbose else logging.INFO)


def warnings_to_terminal() -> None:
    """Log warnings and errors to the error stream: for a program without a person at its terminal.

    Where `to_terminal` shows everything already, nothing is changed.
    """
    if any(type(h) is logging.StreamHandler for h in logging.getLogger(PACKAGES[0]).handlers):
        return
    handler = logging.StreamHandler()
    handler.setLevel(logging.WARNING)
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", _TIME))
    _add(handler, logging.INFO)


def to_file(path: Path) -> None:
    """Log to a rotating file from now on, beginning with program, computer and Python.

    A write error is reported once, on the error stream, and stops nothing.
    """
    _remove(_LogFile)
    with contextlib.suppress(OSError):  # the handler reports it, at its first message
        path.parent.mkdir(parents=True, exist_ok=True)
    handler = _LogFile(path, "a", FILE_BYTES, OLD_FILES, encoding="utf-8", delay=True)
    handler.setFormatter(logging.Formatter(_FORM, _TIME))
    _add(handler, logging.INFO)
    logging.getLogger(__name__).info("%s, log of %s", about(), path)


def about() -> str:
    """Program, Python and computer, in a line."""
    return (
        f"cell {version('cable-cell')}, Python {platform.python_version()}, "
        f"{platform.system()} {platform.release()} {platform.machine()}"
    )


def _add(handler: logging.Handler, level: int) -> None:
    for name in PACKAGES:
        logger = logging.getLogger(name)
        logger.addHandler(handler)
        logger.setLevel(min(level, logger.level or level))


def _remove(kind: type[logging.Handler]) -> None:
    """Remove handlers of exactly this kind, set by an earlier command in the same process."""
    for name in PACKAGES:
        logger = logging.getLogger(name)
        for handler in [h for h in logger.handlers if type(h) is kind]:
            logger.removeHandler(handler)
            handler.close()
