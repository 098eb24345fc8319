"""What is written to the ledger is what is asked for, in a file and on a server."""

from __future__ import annotations

import threading
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from cell.records.folder import UNFINISHED
from cell.records.ledger.entry import Acknowledgement, LedgerEntry
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.result import Outcome

from .conftest import BEGUN, begun, ended, stopped

ALL = LedgerQuery()


def numbers(ledger: Ledger, wanted: LedgerQuery = ALL, most: int | None = None) -> list[int]:
    return [c.cycle for c in ledger.listed(wanted, most)]


def test_a_cycle_is_unfinished_until_it_has_ended(ledger: Ledger) -> None:
    ledger.write([begun(1, part="A-1")])
    (listed,) = ledger.listed(LedgerQuery())
    assert (listed.outcome, listed.ended, listed.part) == (UNFINISHED, None, "A-1")
    assert ledger.results("line3") == []
    ledger.write([ended(1, part="A-1")])
    (listed,) = ledger.listed(LedgerQuery(), estimates=True)
    entry = ended(1, part="A-1")
    assert listed.outcome == "inserted"
    assert (listed.started, listed.ended) == (entry.started, entry.ended)
    assert listed.estimates == entry.estimates
    assert listed.running_s == 25.0
    assert listed.numbers["measured_miss_m"] == 0.3e-3
    assert (listed.model, listed.calibration, listed.software) == ("abc", "c0ffee", "0.1.0")


def test_the_same_entry_again_changes_nothing(ledger: Ledger) -> None:
    """An entry is sent again if nobody knows whether it has arrived."""
    for entry in (begun(1), ended(1), ended(1), begun(1)):
        ledger.write([entry])
    (listed,) = ledger.listed(LedgerQuery(), estimates=True)
    assert listed.outcome == "inserted"
    assert len(listed.estimates) == 2


def test_all_or_none_are_written(ledger: Ledger) -> None:
    wrong = replace(ended(2), aim=None)  # type: ignore[arg-type]
    with pytest.raises(Exception, match="aim"):
        ledger.write([ended(1), wrong])
    assert numbers(ledger) == []


def test_charts_get_what_they_need_oldest_first(ledger: Ledger) -> None:
    outcomes = [Outcome.INSERTED, Outcome.MISSED, Outcome.MEASURED, Outcome.REJECTED]
    ledger.write([ended(n, o) for n, o in enumerate(outcomes)])
    ledger.write([stopped(9), ended(10, line="line4")])
    results = ledger.results("line3")
    assert [r.outcome for r in results] == [Outcome.INSERTED, Outcome.MISSED, Outcome.REJECTED]
    assert [r.cycle for r in ledger.results("line3", most=2)] == [1, 3]
    entry = ended(0).result
    assert entry is not None
    same = ("measured_miss_m", "predicted_miss_m", "predicted_std_m", "residual_rms_m", "noise_m")
    assert all(getattr(results[0], k) == getattr(entry, k) for k in (*same, "model"))
    assert results[0].parameters == {"rigidity_0": 2e-5, "viscosity": 1e-7}


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        (LedgerQuery(), [1, 2, 3, 4, 5]),
        (LedgerQuery(since=BEGUN + timedelta(minutes=4)), [4, 5]),
        (LedgerQuery(until=BEGUN + timedelta(minutes=2)), [1]),
        (LedgerQuery(outcomes=("inserted",)), [1, 4]),
        (LedgerQuery(outcomes=("inserted", UNFINISHED)), [1, 4, 5]),
        (LedgerQuery(outcomes=(UNFINISHED,)), [5]),
        (LedgerQuery(line="line4"), [4]),
        (LedgerQuery(part="A-7"), [1]),
        (LedgerQuery(model="abc", outcomes=("failed",)), [2, 3]),
        (LedgerQuery(fault="arm"), [2, 3]),
        (LedgerQuery(fault="arm.limit"), [2]),
        (LedgerQuery(fault="a_m"), []),
        (LedgerQuery(part="nobody's"), []),
    ],
)
def test_only_what_is_wanted_is_listed(
    ledger: Ledger, wanted: LedgerQuery, found: list[int]
) -> None:
    ledger.write([ended(1, part="A-7"), stopped(2, "arm.limit"), stopped(3, "arm.lost")])
    ledger.write([ended(4, line="line4"), begun(5)])
    assert numbers(ledger, wanted) == found
    assert sum(ledger.count(wanted).values()) == len(found)
    assert numbers(ledger, wanted, most=1) == found[-1:]


def test_cables_not_inserted_are_counted_with_the_newest_reason(ledger: Ledger) -> None:
    outcomes = [Outcome.MISSED, Outcome.REJECTED, Outcome.INSERTED, Outcome.MISSED]
    ledger.write([with_reason(n, outcome) for n, outcome in enumerate(outcomes, start=1)])
    ledger.write([stopped(5), with_reason(6, Outcome.MISSED, line="line4"), begun(7)])
    line3 = LedgerQuery(line="line3")
    assert ledger.not_inserted(line3) == [("missed", 2, "reason 4"), ("rejected", 1, "reason 2")]
    assert ledger.not_inserted(LedgerQuery(outcomes=("inserted",))) == []
    assert ledger.not_inserted(LedgerQuery(part="nobody's")) == []


def with_reason(number: int, outcome: Outcome, **changes: Any) -> LedgerEntry:
    entry = ended(number, outcome, **changes)
    assert entry.result is not None
    return replace(entry, result=replace(entry.result, reason=f"reason {number}"))


def test_faults_are_counted_by_code_with_the_newest_cause(ledger: Ledger) -> None:
    ledger.write([stopped(1, "arm.limit"), stopped(2), stopped(3, "arm.limit"), ended(4)])
    assert ledger.faults(LedgerQuery()) == [("arm.limit", 2, "cause 3"), ("stop", 1, "cause 2")]
    assert ledger.faults(LedgerQuery(fault="stop")) == [("stop", 1, "cause 2")]
    (listed,) = ledger.listed(LedgerQuery(fault="stop"))
    entry = stopped(2).result
    assert entry is not None
    assert listed.fault == entry.fault


def test_a_clock_that_was_set_back_does_not_change_the_order(ledger: Ledger) -> None:
    """Charts look for changes in the order in which cycles were made."""
    ledger.write([ended(1), ended(2)])
    ledger.write([ended(3, started=BEGUN - timedelta(days=1))])
    assert numbers(ledger) == [1, 2, 3]
    assert [r.cycle for r in ledger.results("line3")] == [1, 2, 3]


def test_cycles_of_before_are_taken_in_where_they_were(ledger: Ledger) -> None:
    ledger.write([ended(5), ended(6)])
    ledger.write([ended(2), begun(3)], of_now=False)
    assert numbers(ledger) == [2, 3, 5, 6]


def test_a_part_may_be_tried_again(ledger: Ledger) -> None:
    ledger.write([stopped(1), ended(2, part="Ä 1"), ended(3, part="Ä 1")])
    assert numbers(ledger, LedgerQuery(part="Ä 1")) == [2, 3]


def test_cells_that_write_at_once_wait_for_each_other(place: str) -> None:
    """Four cells begin with a new ledger, and all tell it of parts of the same ids."""
    errors: list[BaseException] = []

    def cell(number: int) -> None:
        try:
            ledger = Ledger(place, create=True)
            for k in range(10):
                n = 100 * number + k
                ledger.write([begun(n, line=f"line{number}", part=f"P{k}")])
                ledger.write([ended(n, line=f"line{number}", part=f"P{k}")])
            ledger.close()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=cell, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    ledger = Ledger(place)
    assert ledger.count(LedgerQuery()) == {"inserted": 40}
    assert len(ledger.listed(LedgerQuery(part="P3"))) == 4
    ledger.close()


def test_folders_are_found_beside_a_ledger_that_was_moved(tmp_path: Path) -> None:
    (tmp_path / "runs" / "00001").mkdir(parents=True)
    ledger = Ledger(tmp_path / "runs", create=True)
    ledger.write([ended(1), ended(2)])
    first, second = ledger.listed(LedgerQuery())
    assert first.folder == tmp_path / "runs" / "00001"
    assert second.folder == Path("/records/00002")
    ledger.close()


def test_a_fault_is_open_until_somebody_acknowledges_it(ledger: Ledger) -> None:
    ledger.write([ended(1), stopped(2), stopped(3, "arm.limit")])
    opened = LedgerQuery(acknowledged=False)
    assert [c.cycle for c in ledger.listed(opened)] == [2, 3]
    assert ledger.count(opened) == {"failed": 2}
    second = ledger.listed(LedgerQuery(fault="arm"))
    ledger.acknowledge(second, Acknowledgement(BEGUN, "Ada", "pads changed"))
    ledger.acknowledge(second, Acknowledgement(BEGUN, "Bob", "pads changed again"))
    assert [c.cycle for c in ledger.listed(opened)] == [2]
    assert [code for code, *_ in ledger.faults(opened)] == ["stop"]
    (seen,) = ledger.listed(LedgerQuery(acknowledged=True))
    assert seen.acknowledged == Acknowledgement(BEGUN, "Bob", "pads changed again")
    assert seen.to_json()["acknowledged_by"] == "Bob"


def test_an_acknowledgement_is_written_after_its_fault(ledger: Ledger) -> None:
    """As the outbox hands them over; what the cycle had measured stays."""
    said = Acknowledgement(BEGUN, "Ada", "looked")
    ledger.write([begun(1), stopped(1), replace(stopped(1), acknowledged=said)])
    (cycle,) = ledger.listed(LedgerQuery(), estimates=True)
    assert (cycle.outcome, cycle.acknowledged) == ("failed", said)
    assert cycle.estimates
    assert (
        LedgerEntry.from_json(replace(stopped(1), acknowledged=said).to_json()).acknowledged == said
    )
    old = begun(1).to_json()
    del old["acknowledged"]
    assert LedgerEntry.from_json(old) == begun(1)


def test_products_do_not_mix(ledger: Ledger) -> None:
    products = ("soft", "stiff", None, "soft")
    ledger.write([ended(n, product=product) for n, product in enumerate(products, 1)])
    assert [r.cycle for r in ledger.results("line3", "soft")] == [1, 4]
    assert [r.cycle for r in ledger.results("line3", "stiff")] == [2]
    assert [r.cycle for r in ledger.results("line3")] == [3]
    for wanted, cycles in ((None, [1, 2, 3, 4]), ("soft", [1, 4]), ("", [3]), ("short", [])):
        listed = ledger.listed(LedgerQuery(product=wanted))
        assert [c.cycle for c in listed] == cycles
        assert sum(ledger.count(LedgerQuery(product=wanted)).values()) == len(cycles)
