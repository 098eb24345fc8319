"""Past cycles at a glance, whatever state their folders are in."""

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.records.folder import Record, history, newest
from cell.records.result import Outcome, Result


def record(runs: Path, cycle: int, second: int, outcome: Outcome | None) -> Path:
    made = Record(runs, cycle, datetime(2026, 11, 22, 1, 2, second))
    made.state(step="execute")
    made.pictures({"b": np.zeros((4, 4, 3), np.uint8), "a": np.zeros((4, 4, 3), np.uint8)})
    if outcome is not None:
        error_m = 1e-4 if outcome is Outcome.INSERTED else None
        made.close(Result(cycle, outcome, str(made.folder), 0.024, prediction_error_m=error_m))
    return made.folder


def test_cycles_are_listed_by_time_with_outcome_and_pictures(tmp_path: Path) -> None:
    last = record(tmp_path, 1, 30, Outcome.INSERTED)
    record(tmp_path, 12, 10, None)
    broken = record(tmp_path, 2, 20, Outcome.FAILED)
    (broken / "result.json").write_text("{")
    (tmp_path / "study").mkdir()
    (tmp_path / "cell.log").write_text("")
    past = history(tmp_path)
    assert [p.outcome for p in past] == ["running or killed", "unreadable", "inserted"]
    assert [p.cycle for p in past] == [12, 2, 1]
    assert past[0].step == "execute"
    assert past[2].pictures == ("a.jpg", "b.jpg")
    assert (past[2].offset_m, past[2].prediction_error_m) == (0.024, 1e-4)
    assert past[2].started == datetime(2026, 11, 22, 1, 2, 30).astimezone()
    assert past[2].to_json()["started"] == past[2].started.isoformat()
    assert newest(tmp_path) == last


def test_a_folder_without_cycles_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder of cycles"):
        history(tmp_path / "absent")
    with pytest.raises(InputError, match="holds no cycle"):
        newest(tmp_path)
