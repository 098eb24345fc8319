"""What a cycle leaves behind can be read at every moment, and says how far the cycle came."""

from __future__ import annotations

import json
import time
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from cell.cable.geometry import Cable, Motion
from cell.files.input_error import InputError
from cell.records.folder import Record, RecordError, history, read_record
from cell.records.result import Fault, Outcome, Result
from cell.study.data import Markers, Study, Trial

MODEL = {
    "parameters": [{"name": "exponent", "value": 1.0, "low": 0.9, "high": 1.1, "unit": ""}],
    "inflation": 1.0,
}
NOW = datetime(2026, 11, 21, 1, 2, 3, 456789)
T_S = np.array([0.0, 0.1, 0.2])
STUDY = Study(
    "cycle 2",
    Cable(0.1, 0.0074, 0.016, 1e-4),
    np.array([0.1, 0.0]),
    (
        Trial(
            "identify",
            "fit",
            "equilibrium",
            Motion(T_S, 0 * T_S, 0 * T_S, 0 * T_S),
            Markers(T_S, np.full((3, 2, 2), [[-0.09, -0.03], [0.0, 0.0]])),
        ),
    ),
)


def test_every_stage_of_a_cycle_is_readable(tmp_path: Path) -> None:
    record = Record(tmp_path / "runs", 2, NOW)
    assert record.folder.name == "20261121T010203.456-2"

    record.state(step="grasp", state="execute")
    read = read_record(record.folder)
    assert (read.cycle, read.step, read.closed) == (2, "grasp", False)
    assert read.study is read.model is read.result is None

    record.state(step="identify")
    record.study(STUDY)
    record.model(MODEL)
    read = read_record(record.folder)
    assert read.step == "identify"
    assert read.study is not None
    np.testing.assert_array_equal(read.study.trials[0].markers.t_s, T_S)
    assert read.model == MODEL
    assert not read.closed

    result = Result(2, Outcome.INSERTED, str(record.folder), offset_m=0.012, seconds={"grasp": 0.4})
    record.close(result)
    read = read_record(record.folder)
    assert read.closed
    assert read.result == result


def test_a_state_is_written_in_order_by_a_thread_and_its_error_is_raised_at_the_next(
    tmp_path: Path,
) -> None:
    record = Record(tmp_path, 2, NOW)
    for step in ("grasp", "lower", "hold_and_capture"):
        record.state_soon(step=step)
    record.state(state="execute")
    assert read_record(record.folder).step == "hold_and_capture"

    (record.folder / "state.json").unlink()
    (record.folder / "state.json").mkdir()
    deadline_s = time.monotonic() + 30
    with pytest.raises(RecordError, match="cannot be written"):
        while time.monotonic() < deadline_s:
            record.state_soon(step="release")
            time.sleep(0.001)
    with pytest.raises(RecordError):
        record.state(step="release")

    (record.folder / "state.json").rmdir()
    record.close(Result(2, Outcome.INSERTED, str(record.folder)))
    assert read_record(record.folder).closed


def test_a_folder_with_an_impossible_date_is_no_cycle_s(tmp_path: Path) -> None:
    (tmp_path / "99999999T999999.000-1").mkdir()
    Record(tmp_path, 2, NOW).state(step="grasp")
    assert [past.cycle for past in history(tmp_path)] == [2]


def test_a_result_goes_through_json_with_its_fault_and_without_nan() -> None:
    result = Result(
        1,
        Outcome.FAILED,
        "runs/x",
        margin_m=float("nan"),
        fault=Fault("lower", "fell silent", "arm", "connect again"),
    )
    text = json.dumps(result.to_json(), allow_nan=False)
    read = Result.from_json(json.loads(text))
    assert read.fault == result.fault
    assert read.outcome is Outcome.FAILED
    assert read.margin_m is None


def test_pictures_and_settings_are_written_whole(tmp_path: Path) -> None:
    record = Record(tmp_path, 1, NOW)
    record.pictures({"overlay": np.zeros((4, 5, 3), np.uint8)})
    record.settings({"gripper": {"force_n": 20.0}})
    names = {f.name for f in record.folder.iterdir()}
    assert names == {"overlay.jpg", "settings.yaml", "reserve"}, "no half-written file may stay"


def test_a_record_never_writes_into_another_one(tmp_path: Path) -> None:
    Record(tmp_path, 1, NOW)
    with pytest.raises(RecordError, match="File exists"):
        Record(tmp_path, 1, NOW)


_STATE = '{"format": "cable-cycle/1", "cycle": 1, "closed": true}'


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (None, r"state\.json:1: is missing: not a cycle's folder"),
        ('{"format": "cable-cycle/9"}', "format: should be 'cable-cycle/1', not 'cable-cycle/9'"),
        ('{"format": ', r"state\.json:1:\d+: is not JSON"),
        (
            '{"format": "cable-cycle/1", "closed": true}',
            r"state\.json:1:1: cycle: is missing; give the file",
        ),
        (_STATE, r"result\.json:1:35: fault\.cause: should be a valid string, not 1; give the"),
    ],
)
def test_what_is_not_a_record_is_refused_by_name(
    tmp_path: Path, state: str | None, said: str
) -> None:
    (tmp_path / "result.json").write_text('{"outcome": "inserted", "fault": {"cause": 1}}')
    if state is not None:
        (tmp_path / "state.json").write_text(state)
    with pytest.raises(InputError, match=said):
        read_record(tmp_path)


def test_a_model_that_is_not_finite_is_refused_and_leaves_the_old_one(tmp_path: Path) -> None:
    record = Record(tmp_path, 1, NOW)
    record.state()
    record.model(MODEL)
    with pytest.raises(ValueError, match="not JSON compliant"):
        record.model({"exponent": float("nan")})
    assert read_record(record.folder).model == MODEL
