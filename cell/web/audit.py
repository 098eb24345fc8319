"""Audit log: every action at the pages, as lines of JSON next to the folder of the records."""

from __future__ import annotations

import errno
import json
import os
import threading
from datetime import UTC, datetime
from pathlib import Path


def audit_file(runs: Path) -> Path:
    """Path of the log of the cell whose records are in `runs`."""
    folder = runs.resolve()
    return folder.with_name(f"{folder.name}.actions.jsonl")


class Audit:
    """Appends one line for each action; safe to be used from several threads."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._lock = threading.Lock()

    def write(self, by: str, action: str, done: bool, note: str = "") -> None:
        """Append an action.  Raises OSError: it cannot be written, or not all of it.

        by      user who did it, or tried to
        done    whether it was allowed and accepted
        """
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        row = {"at": at, "by": by, "action": action, "done": done, "note": note}
        line = json.dumps(row, ensure_ascii=False) + "\n"
        with self._lock:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.file, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o600)
            try:
                data = (f"\n{line}" if _torn(descriptor) else line).encode()
                if os.write(descriptor, data) < len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.file))
            finally:
                os.close(descriptor)


def _torn(descriptor: int) -> bool:
    """Whether the last line is incomplete, as after a power cut: the next would be lost with it."""
    if os.fstat(descriptor).st_size == 0:
        return False
    os.lseek(descriptor, -1, os.SEEK_END)
    return os.read(descriptor, 1) != b"\n"
