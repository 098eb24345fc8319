"""Standard output and error as they are: full, closed half way, or without the signs of Unicode."""

from __future__ import annotations

import codecs
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from cell.cli.shared import NOT_ALL_DONE

#: Signs that the commands print, for terminals that lack them.
_PLAIN = {
    "…": "...", "×": "x", "±": "+-", "−": "-", "–": "-", "—": "-", "→": "->", "·": "*", "≤": "<=",
    "≥": ">=", "≈": "~", "µ": "u", "μ": "u", "²": "^2", "³": "^3", "°": " deg", "σ": "sigma",
    "χ": "chi", "ρ": "rho", "κ": "kappa", "₀": "0", "✓": "ok", "“": '"', "”": '"', "‑": "-",
}  # fmt: skip


class OutputClosedError(Exception):
    """Standard output takes no more.  Scenario: `cell run --json | head -1`, or a full disk."""

    def __init__(self, cause: OSError) -> None:
        super().__init__(f"the output cannot be written: {cause.strerror}")
        self.by_reader = isinstance(cause, BrokenPipeError)


def emit(line: str) -> None:
    """Print a line at once.  Raises OutputClosedError."""
    try:
        print(line, flush=True)
    except OSError as error:
        raise OutputClosedError(error) from error


@contextmanager
def usable_streams() -> Iterator[None]:
    """What is printed arrives, in plainer signs if need be, or the program says that it did not.

    Ends with 1 if standard output takes no more; silently if its reader went away, who knows.
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
        if isinstance(error, OSError) and error.filename is not None:
            print(f"{error.filename}: {error.strerror}", file=sys.stderr)
            raise SystemExit(NOT_ALL_DONE) from error
        closed = error if isinstance(error, OutputClosedError) else OutputClosedError(error)
        # Whatever is left in the buffer would fail again at exit, with a traceback.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not closed.by_reader:
            with suppress(OSError):  # of a terminal that was closed both are gone
                print(closed, file=sys.stderr)
        raise SystemExit(NOT_ALL_DONE) from error
    if ending is not None:
        raise ending


def _plainly(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lost = error.object[error.start : error.end]
    return "".join(_PLAIN.get(sign, "?") for sign in lost), error.end
