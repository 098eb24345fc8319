"""Cycles that an earlier service has left, whatever its clock and its zone were."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from cell.plant.service import EarlierCycles, earlier_cycles
from cell.records.folder import Record, acknowledge_record, history, newest
from cell.records.result import Fault, Outcome, Result

NOON = datetime(2026, 11, 22, 12, tzinfo=UTC)


@pytest.fixture(autouse=True)
def zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield
    monkeypatch.undo()
    time.tzset()


def in_zone(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("TZ", name)
    time.tzset()


def left(runs: Path, cycle: int, outcome: Outcome | None, began: datetime = NOON) -> Path:
    """Folder of a cycle; None = it was killed."""
    record = Record(runs, cycle, began.astimezone())
    record.state(step="lower")
    if outcome is not None:
        fault = Fault("lower", "guard opened", code="stop") if outcome is Outcome.FAILED else None
        record.close(Result(cycle, outcome, str(record.folder), fault=fault))
    return record.folder


def test_good_and_acknowledged_cycles_leave_nothing_to_be_looked_at(tmp_path: Path) -> None:
    assert earlier_cycles(tmp_path / "absent") == earlier_cycles(tmp_path) == EarlierCycles()
    left(tmp_path, 7, Outcome.INSERTED)
    acknowledge_record(left(tmp_path, 8, None), "Ada", "looked")
    acknowledge_record(left(tmp_path, 3, Outcome.FAILED), "Ada", "looked")
    (tmp_path / "study").mkdir()
    assert earlier_cycles(tmp_path) == EarlierCycles(8)


@pytest.mark.parametrize("outcome", [None, Outcome.FAILED])
@pytest.mark.parametrize("back", [timedelta(hours=1), timedelta(days=9000)])
def test_a_clock_that_was_set_back_hides_no_cycle(
    tmp_path: Path, outcome: Outcome | None, back: timedelta
) -> None:
    left(tmp_path, 1, Outcome.INSERTED)
    folder = left(tmp_path, 2, outcome, NOON - back)
    found = earlier_cycles(tmp_path)
    assert (found.cycle, found.open) == (2, (folder,))
    assert found.fault is not None and found.fault.cycle == 2


@pytest.mark.parametrize(
    ("before", "after", "began"),
    [
        ("CEST-2", "CET-1", NOON),
        ("Europe/Berlin", "Europe/Berlin", datetime(2026, 10, 25, 0, 50, tzinfo=UTC)),
    ],
    ids=["another zone", "the hour that comes twice in autumn"],
)
def test_cycles_are_in_the_order_in_which_they_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str, began: datetime
) -> None:
    """A folder is named by local time, and an older cycle counted as the newest."""
    in_zone(monkeypatch, before)
    first = left(tmp_path, 1, Outcome.INSERTED, began)
    in_zone(monkeypatch, after)
    second = left(tmp_path, 2, None, began + timedelta(minutes=20))
    third = left(tmp_path, 1, None, began + timedelta(minutes=20, microseconds=10))
    assert first.name > second.name
    assert [p.folder for p in history(tmp_path)] == [first, second, third]
    assert [p.started.astimezone(UTC) - began for p in history(tmp_path)][:2] == [
        timedelta(0),
        timedelta(minutes=20),
    ]
    assert newest(tmp_path) == third
    found = earlier_cycles(tmp_path)
    assert (found.cycle, found.open) == (2, (second, third))


def test_folders_of_older_versions_are_ordered_by_their_names(tmp_path: Path) -> None:
    old = left(tmp_path, 4, None, NOON + timedelta(hours=1))
    state = json.loads((old / "state.json").read_text())
    del state["started"]
    (old / "state.json").write_text(json.dumps(state))
    new = left(tmp_path, 5, None)
    assert earlier_cycles(tmp_path).open == (new, old)


def test_of_several_the_newest_is_told_and_names_the_others(tmp_path: Path) -> None:
    for number in range(1, 7):
        left(tmp_path, number, Outcome.FAILED, NOON + timedelta(minutes=number))
    fault = earlier_cycles(tmp_path).fault
    assert fault is not None
    assert (fault.cycle, fault.step, fault.code) == (6, "lower", "stop")
    assert fault.cause == "guard opened; not acknowledged either: cycles 5, 4, 3, … (5)"


@pytest.mark.parametrize("name", ["state.json", "result.json"])
def test_a_cycle_that_cannot_be_read_waits_for_a_person_too(tmp_path: Path, name: str) -> None:
    """A computer that lost its power may leave an empty file."""
    folder = left(tmp_path, 2, Outcome.FAILED)
    (folder / name).write_text("")
    fault = earlier_cycles(tmp_path).fault
    assert fault is not None and "cycle 2 cannot be read" in fault.cause
    acknowledge_record(folder, "Ada", "looked")
    assert earlier_cycles(tmp_path) == EarlierCycles(2)
    assert (folder / "state.json.unreadable").exists() == (name == "state.json")


def test_a_cycle_killed_before_its_first_state_is_acknowledged_for_good(tmp_path: Path) -> None:
    """The next service ended with 2: its state had no number."""
    folder = Record(tmp_path, 2, NOON).folder
    fault = earlier_cycles(tmp_path).fault
    assert fault is not None and "cycle 2 was not finished" in fault.cause
    acknowledge_record(folder, "Ada", "looked")
    assert earlier_cycles(tmp_path) == EarlierCycles(2)
