"""Makes standard output and error usable where they are closed, full or without Unicode."""

from __future__ import annotations

import codecs
import errno
import io
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from cell.cli.shared import ALL_DONE, NOT_ALL_DONE
from cell.files.rescue import why_not_written

#: Signs that the commands print, for terminals that lack them.
_PLAIN = {
    "…": "...", "×": "x", "±": "+-", "−": "-", "–": "-", "—": "-", "→": "->", "·": "*", "≤": "<=",
    "≥": ">=", "≈": "~", "µ": "u", "μ": "u", "²": "^2", "³": "^3", "°": " deg", "σ": "sigma",
    "χ": "chi", "ρ": "rho", "κ": "kappa", "₀": "0", "✓": "ok", "“": '"', "”": '"', "‑": "-",
}  # fmt: skip


class OutputClosedError(Exception):
    """Standard output takes no more.  Scenario: `cell run --json | head -1`, or a full disk."""

    def __init__(self, cause: OSError) -> None:
        why = "it is closed" if cause.errno == errno.EBADF else cause.strerror
        super().__init__(f"the output cannot be written: {why}")
        self.by_reader = isinstance(cause, BrokenPipeError)


def emit(line: str) -> None:
    """Print a line at once.  Raises OutputClosedError."""
    try:
        print(line, flush=True)
    except OSError as error:
        raise OutputClosedError(error) from error


@contextmanager
def without_reader() -> Iterator[None]:
    """Print, and go on in silence if the reader goes away: the exit code is that of the work.

    raises  OutputClosedError, OSError: the output is closed or its disk is full
    """
    try:
        with reporting_reader():
            yield
    except OutputClosedError as error:
        if not error.by_reader:
            raise
        silence()


@contextmanager
def reporting_reader() -> Iterator[None]:
    """Raise OutputClosedError if the output's reader went away: Typer and rich would end with 1."""
    try:
        yield
    except BrokenPipeError as error:  # may be that of another pipe
        poll = select.poll()
        poll.register(sys.stdout, 0)
        if not poll.poll(0):
            raise
        raise OutputClosedError(error) from error
    except SystemExit as error:  # of rich, whose console silences the output
        if not isinstance(error.__context__, BrokenPipeError):
            raise
        raise OutputClosedError(error.__context__) from error


def silence() -> None:
    """Drop all further output: the rest of the buffer would fail at exit, with a traceback."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def is_in_foreground(descriptor: int) -> bool:
    """Whether a terminal is there and is ours: one in the background that touches it is halted."""
    try:
        return os.tcgetpgrp(descriptor) == os.getpgrp()
    except OSError:
        return False


class _Unheard(io.FileIO):
    """An error stream that may be full or gone: messages are lost, the work goes on."""

    def write(self, data: Any, /) -> int:
        """Number of bytes, written or not."""
        try:
            return super().write(data)
        except OSError:
            return len(data)


def open_streams() -> None:
    """Replace closed standard streams: reading gives the end, output fails, errors are dropped.

    To be called before anything is opened, forked or printed: a file would get the number of a
    closed stream, and whatever prints would write into it.
    """
    if sys.stdin is None:
        sys.stdin = os.fdopen(_nothing(os.O_RDONLY), "r")
    if sys.stdout is None:
        sys.stdout = os.fdopen(_nothing(os.O_RDONLY), "w")  # a write fails, as to a closed one
    number = _nothing(os.O_WRONLY) if sys.stderr is None else sys.stderr.fileno()
    encoding = None if sys.stderr is None else sys.stderr.encoding
    unheard = io.BufferedWriter(_Unheard(number, "w", closefd=False))
    sys.stderr = io.TextIOWrapper(unheard, encoding, "backslashreplace", line_buffering=True)


def _nothing(flags: int) -> int:
    """Number of a stream that is empty, or swallows all."""
    number = os.open(os.devnull, flags)
    os.set_inheritable(number, True)
    return number


@contextmanager
def usable_streams() -> Iterator[None]:
    """Print with replacements for missing characters; report output that cannot be written.

    Ends with 1 if standard output takes no more; if its reader went away, with the work's code.
    """
    codecs.register_error("plain", _plainly)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="plain")
    ending: BaseException | None = None
    try:
        try:
            yield
        except SystemExit as error:
            ending = error
        sys.stdout.flush()
    except (OutputClosedError, OSError) as error:
        closed = _as_closed_output(error)
        if closed is None:
            assert isinstance(error, OSError)
            print(why_not_written(error), file=sys.stderr)
            raise SystemExit(NOT_ALL_DONE) from error
        silence()
        if closed.by_reader:
            raise (ending or SystemExit(ALL_DONE)) from error
        with suppress(OSError):  # of a terminal that was closed both are gone
            print(closed, file=sys.stderr)
        raise SystemExit(NOT_ALL_DONE) from error
    if ending is not None:
        raise ending


def _as_closed_output(error: OutputClosedError | OSError) -> OutputClosedError | None:
    """The error as that of a closed standard output; None = it has a different cause.

    An error of a file has its name: see `cell.files.rescue.naming`.
    """
    if isinstance(error, OutputClosedError):
        return error
    if error.filename is not None or error.errno is None:
        return None
    return OutputClosedError(error)


def _plainly(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lost = error.object[error.start : error.end]
    return "".join(_PLAIN.get(sign, "?") for sign in lost), error.end
