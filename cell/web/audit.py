"""Audit log: every action at the pages, as lines of JSON beside the folder of the records."""

from __future__ import annotations

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
        """Append an action.  Raises OSError: it cannot be written; the action is then not done.

        by      whoever did it, or tried to
        done    whether it was allowed and accepted
        """
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        row = {"at": at, "by": by, "action": action, "done": done, "note": note}
        line = json.dumps(row, ensure_ascii=False) + "\n"
        with self._lock:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
            try:
                os.write(descriptor, line.encode())
            finally:
                os.close(descriptor)
