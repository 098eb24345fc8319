"""Where jobs are to be done, as a person or the settings say it."""

from __future__ import annotations

from cell.workers.executor import WorkersError

#: How the address of a scheduler begins.
SCHEMES = ("tcp://", "tls://")


def place(text: str) -> str | int:
    """Address of a scheduler, or a number of cores.  Raises WorkersError: it is neither."""
    if text.startswith(SCHEMES) and text.rpartition(":")[2].isdecimal():
        return text
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise WorkersError(
        f"--workers {text}: is neither a number of cores nor the address of a Dask scheduler; "
        "give 2, or tcp://host:8786"
    )
