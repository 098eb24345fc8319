"""Runs an adapter as a child of the service, at lower priority; it ends with its parent.

python -m cell.plant.child PARENT WORDS … is `cell WORDS …` as a child of the process PARENT.
"""

from __future__ import annotations

import os
import runpy
import sys
from contextlib import suppress

from cell.computer.forks import end_with_parent

#: Of adapters, against -10 of a cell with real devices; a PLC is still answered in time.
NICE = 10


def main() -> None:
    """Replace this process by the `cell` command in its arguments."""
    parent, *words = sys.argv[1:]
    end_with_parent(int(parent))
    with suppress(AttributeError, OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    sys.argv = ["cell", *words]
    runpy.run_module("cell", run_name="__main__")


if __name__ == "__main__":
    main()
