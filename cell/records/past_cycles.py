"""Summary of the past cycles in a folder: outcome and pictures of each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from cell.files.input_error import InputError, Problem
from cell.records.folder import FORMAT, cycle_of, pictures_in, started_of

#: Said of a cycle that has no outcome.
UNFINISHED = "running or killed"


@dataclass(frozen=True)
class PastCycle:
    """A cycle that was.

    started             with a time zone
    outcome             as in its result; "running or killed" without one; "unreadable"
    step                in which it ended
    offset_m, prediction_error_m   None = not known
    pictures            names of its picture files, sorted
    """

    folder: Path
    started: datetime
    cycle: int
    outcome: str
    step: str = ""
    offset_m: float | None = None
    prediction_error_m: float | None = None
    pictures: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return vars(self) | {
            "folder": str(self.folder),
            "started": self.started.isoformat(),
            "pictures": list(self.pictures),
        }


def history(runs: Path) -> tuple[PastCycle, ...]:
    """All cycles that left a folder in `runs`, the newest last.

    Folders of another kind are left out; a cycle whose files are broken is said to be unreadable.
    raises  InputError: `runs` is no folder
    """
    if not runs.is_dir():
        message = "is no folder of cycles; give the one that `cell run --runs` wrote to"
        raise InputError([Problem(runs, 1, None, "", message)])
    past = [_past(f, number) for f in runs.iterdir() if (number := cycle_of(f)) is not None]
    return tuple(sorted(past, key=lambda p: (p.started, p.cycle)))


def newest(runs: Path) -> Path:
    """Folder of the newest cycle.  Raises InputError: there is none."""
    past = history(runs)
    if not past:
        raise InputError([Problem(runs, 1, None, "", "holds no cycle; run one with `cell run`")])
    return past[-1].folder


def _past(folder: Path, cycle: int) -> PastCycle:
    state: Mapping[str, Any] | None = None
    try:
        state, result = _read(folder / "state.json"), _read(folder / "result.json")
        assert state is None or state["format"] == FORMAT
    except (OSError, ValueError, KeyError, AssertionError):
        return PastCycle(folder, started_of(folder, state), cycle, "unreadable")
    known = result or {}
    return PastCycle(
        folder,
        started_of(folder, state),
        cycle,
        str(known.get("outcome", UNFINISHED)),
        str((state or {}).get("step", "")),
        known.get("offset_m"),
        known.get("prediction_error_m"),
        tuple(picture.name for picture in pictures_in(folder)),
    )


def _read(path: Path) -> Mapping[str, Any] | None:
    """A JSON object; None = no such file."""
    if not path.exists():
        return None
    data = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(data, dict):
        raise ValueError(f"{path}: no JSON object")
    return data
