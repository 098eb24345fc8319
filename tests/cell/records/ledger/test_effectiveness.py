"""Availability, performance and quality of shifts."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, time, timedelta
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cell.records.ledger.effectiveness import Shift, shifts
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.result import Outcome

from .conftest import begun, ended, stopped

DAY = datetime(2026, 11, 2)
BEGINS = [time(6), time(14), time(22)]


def at(hour: float) -> datetime:
    """Local time."""
    return (DAY + timedelta(hours=hour)).astimezone()


@pytest.fixture
def ledger(tmp_path: Path) -> Iterator[Ledger]:
    """In a file: shares are computed from what any database answers."""
    ledger = Ledger(tmp_path / "runs", create=True)
    yield ledger
    ledger.close()


@pytest.fixture
def shifted(ledger: Ledger) -> Ledger:
    cycles = [(6.5, Outcome.INSERTED)] * 6 + [(13.9, Outcome.MISSED)] * 2
    cycles += [(23.0, Outcome.INSERTED), (30.1, Outcome.REJECTED), (31.0, Outcome.MEASURED)]
    entries = []
    for n, (hour, outcome) in enumerate(cycles):
        aim = "measured" if outcome is Outcome.MEASURED else "inserted"
        entries.append(ended(n, outcome, started=at(hour) + timedelta(seconds=n), aim=aim))
    ledger.write([*entries, begun(20, started=at(31.5))])
    return ledger


def test_shares_are_those_of_the_definition(shifted: Ledger) -> None:
    first, night, early = shifts(shifted, LedgerQuery(), BEGINS, at(32), ideal_s=20.0)
    assert (first.begin, first.end) == (at(6), at(14))
    assert (first.cables, first.inserted) == (8, 6)
    assert first.availability == pytest.approx(8 * 25.0 / (8 * 3600.0))
    assert first.performance == pytest.approx(20.0 / 25.0)
    assert first.quality == pytest.approx(6 / 8)
    assert first.oee == pytest.approx(first.availability * 0.8 * 0.75)
    assert (night.begin, night.cables) == (at(22), 1)
    assert early.begin == at(30)
    assert early.planned_s == 2 * 3600.0  # it has not ended yet
    assert early.quality == 0.0  # measured and unfinished cycles are no cables to be inserted


def test_only_the_time_that_is_asked_for_is_planned(shifted: Ledger) -> None:
    wanted = LedgerQuery(since=at(10), until=at(13.95))
    (first,) = shifts(shifted, wanted, BEGINS, at(32))
    assert first.planned_s == pytest.approx(3.95 * 3600.0)
    assert (first.cables, first.inserted) == (2, 0)
    assert first.ideal_s is None  # nothing was inserted meanwhile
    assert first.performance is None


def test_the_ideal_cycle_is_that_of_the_quickest_tenth(ledger: Ledger) -> None:
    for n in range(21):
        result = replace(ended(n).result, state_seconds={"execute": 20.0 + n})
        ledger.write([ended(n, result=result, started=at(7))])
    (shift,) = shifts(ledger, LedgerQuery(), BEGINS, at(8))
    assert shift.ideal_s == 22.0


@pytest.mark.parametrize(
    ("code", "cables", "quality"), [("arm.limit", 2, 0.5), ("stop", 1, 1.0)], ids=["fault", "stop"]
)
def test_a_fault_is_no_insertion_and_a_stop_by_a_person_is_no_cable(
    ledger: Ledger, code: str, cables: int, quality: float
) -> None:
    ledger.write([ended(1), stopped(2, code)])
    now = datetime(2026, 11, 3, tzinfo=UTC)
    (shift,) = shifts(ledger, LedgerQuery(), [time(0)], now)
    assert (shift.cables, shift.quality, shift.running_s) == (cables, quality, 50.0)
    assert shifts(ledger, LedgerQuery(line="other"), [time(0)], now) == []


def test_performance_is_never_above_one() -> None:
    """Rejected cables need less than the ideal time: the page said 106 %."""
    shift = Shift(at(6), at(14), 1000.0, 100.0, 26.5, 4, 2)
    assert shift.performance == 1.0
    assert shift.oee == pytest.approx(0.1 * 0.5)


def test_a_clock_that_was_set_back_loses_no_cable(ledger: Ledger) -> None:
    ledger.write([ended(1, started=at(15)), ended(2, started=at(-40))])
    found = shifts(ledger, LedgerQuery(), BEGINS, at(32))
    assert [s.cables for s in found] == [2]


def test_simulated_time_that_is_quicker_than_the_clock_has_no_availability() -> None:
    shift = Shift(at(6), at(14), 100.0, 300.0, 10.0, 3, 3)
    assert shift.availability is None
    assert shift.oee is None
    assert shift.to_json()["quality"] == 1.0


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(0.0, 100.0), min_size=1, max_size=30),
    st.lists(st.times(timezones=st.none()), min_size=1, max_size=4, unique=True),
)
def test_every_cable_is_in_one_shift(hours: list[float], begins: list[time]) -> None:
    """Whenever shifts begin."""
    ledger = Ledger("sqlite://", create=True)
    ledger.write([ended(n, started=at(h)) for n, h in enumerate(hours)])
    found = shifts(ledger, LedgerQuery(), begins, at(200))
    assert sum(s.cables for s in found) == len(hours)
    assert all(a.end <= b.begin for a, b in itertools.pairwise(found))
    ledger.close()
