"""Every minute of a shift has a cause: compared with a calculation by hand and a simulated week."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import datetime, time, timedelta
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.stats import binomtest

from cell.files.input_error import InputError
from cell.records.ledger.entry import Acknowledgement, LedgerEntry
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.ledger.losses import (
    FailureTimes,
    PassingShare,
    ShiftLosses,
    failure_times,
    merged,
    read_forecasts,
    shift_losses,
)
from cell.records.result import Fault, Outcome, Result
from cell.settings import load_settings

DAY = datetime(2026, 11, 2)
BEGINS = [time(6), time(14), time(22)]
MISSED = "the tip missed the destination by 0.42 mm"
CONVEYOR = "the conveyor's photo eye is dirty, maintenance is on its way"
OFF = ("not running", "")


def at(hour: float, minute: float = 0.0) -> datetime:
    """Local time."""
    return (DAY + timedelta(hours=hour, minutes=minute)).astimezone()


@pytest.fixture
def ledger(tmp_path: Path) -> Iterator[Ledger]:
    ledger = Ledger(tmp_path / "runs", create=True)
    yield ledger
    ledger.close()


def cycle(
    number: int,
    end: datetime,
    outcome: Outcome,
    states: Mapping[str, float],
    waited: Mapping[str, float] | None = None,
    **result: object,
) -> LedgerEntry:
    """A cycle that ended, with the times of its states and the waits before its end, s."""
    started = end - timedelta(seconds=sum(s for name, s in states.items() if name != "idle"))
    steps = {"lower": 1.0, "identify": states["execute"] - 1.0}
    of = Result(number, outcome, "", state_seconds=states, seconds=steps, model="abc", **result)
    folder = Path(f"/records/{number:05d}")
    aim = "measured" if outcome is Outcome.MEASURED else "inserted"
    return LedgerEntry(
        "line3", number, folder, started, aim, ended=end, result=of, waited=waited or {}
    )


def minutes_of(shift: ShiftLosses) -> dict[tuple[str, str], float]:
    return {(x.kind.value, x.reason): x.lasted.total_seconds() / 60.0 for x in shift.losses}


def by_hand() -> list[LedgerEntry]:
    limit = Fault("lower", "the arm is at its limit", "arm", code="arm.limit")
    stopped = cycle(4, at(6, 24), Outcome.FAILED, {"execute": 30}, fault=limit)
    killed = LedgerEntry("line3", 7, Path("/records/00007"), at(6, 45), "inserted")
    waited = {"start": 60, "acknowledgement": 600, "reset": 240}
    unlikely = "no offset passes with probability ≥ 0.95: the best, 20 mm, with 0.61"
    return [
        cycle(1, at(6, 16), Outcome.INSERTED, {"idle": 300, "execute": 60}, {"start": 300}),
        cycle(2, at(6, 20), Outcome.MISSED, {"held": 120, "execute": 120}, reason=MISSED),
        cycle(3, at(6, 23.5), Outcome.INSERTED, {"suspended": 180, "execute": 30}, {CONVEYOR: 180}),
        replace(stopped, acknowledged=Acknowledgement(at(6, 34), "Ada", "moved")),
        cycle(
            *(5, at(6, 41.5), Outcome.REJECTED, {"idle": 60, "execute": 30}, waited),
            reason=unlikely,
        ),
        cycle(6, at(6, 43), Outcome.MEASURED, {"execute": 90}),
        killed,
        cycle(
            *(8, at(7), Outcome.INSERTED, {"execute": 30}),
            {"acknowledgement": 60, "reset": 30},
        ),
    ]


BY_HAND = {
    ("waiting", "start"): 6.0,
    ("waiting", "unhold"): 2.0,
    ("waiting", CONVEYOR[:50]): 3.0,
    ("waiting", "reset"): 4.5,
    ("stopped", "arm.limit"): 10.5,
    ("stopped", "unfinished"): 1.0,
    ("missed", "the tip missed the destination by … mm"): 2.0,
    ("rejected", "no offset passes with probability ≥ …: the best, … mm, with …"): 0.5,
    ("slower", ""): 0.5,
    ("other", "measured"): 1.5,
    ("unfinished", ""): 0.5,
    OFF: 36.5,
}


def test_each_minute_has_the_cause_that_a_calculation_by_hand_gives_it(ledger: Ledger) -> None:
    ledger.write(by_hand())
    (shift,) = shift_losses(ledger, LedgerQuery(), BEGINS, at(7, 10), 30.0)
    assert minutes_of(shift) == pytest.approx(BY_HAND)
    assert shift.productive == timedelta(minutes=1.5)
    assert shift.productive + sum((x.lasted for x in shift.losses), timedelta()) == shift.planned
    assert shift.planned == timedelta(minutes=70)
    said = {x.kind.value: x for x in shift.losses if x.reason != "unfinished"}
    assert said["stopped"].evidence == (
        "the arm is at its limit; acknowledged by Ada at 11-02 06:34: moved"
    )
    assert said["missed"].evidence == MISSED
    assert [c.cycle for c in said["missed"].cycles] == [2]
    assert said["missed"].physics == ""
    assert "identify" in said["slower"].evidence
    assert said["not running"].cycles == ()
    operating = timedelta(minutes=70 - 10.5 - 1.0 - 36.5)
    assert failure_times([shift]) == [
        FailureTimes("arm.limit", 1, operating, timedelta(minutes=10.5)),
        FailureTimes("unfinished", 1, operating, timedelta(minutes=1)),
    ]


@pytest.mark.parametrize(
    ("since", "until", "waits", "cause", "minutes"),
    [
        ((6, 12), (6, 14), {}, ("waiting", "start"), 2.0),  # within a wait
        ((6, 24), (6, 30), {}, ("stopped", "arm.limit"), 6.0),  # the fault is of before
        ((6, 34), (6, 40.5), {}, ("waiting", "reset"), 4.0),  # the next cycle comes later
        ((6, 50), (8, 0), {"start": 3600.0}, ("waiting", "start"), 60.0),  # waits now
    ],
)
def test_a_wait_counts_where_it_was(
    ledger: Ledger,
    since: tuple[float, float],
    until: tuple[float, float],
    waits: dict[str, float],
    cause: tuple[str, str],
    minutes: float,
) -> None:
    ledger.write(by_hand())
    wanted = LedgerQuery(since=at(*since), until=at(*until), line="line3")
    found = shift_losses(ledger, wanted, BEGINS, at(8), 30.0, waits_now=waits)
    assert minutes_of(found[0])[cause] == pytest.approx(minutes)
    lost = sum((x.lasted for x in found[0].losses), found[0].productive)
    assert lost == found[0].planned == at(*until) - at(*since)


def test_time_before_the_first_cycle_is_not_said_to_be_as_short_as_that_after_it(
    ledger: Ledger,
) -> None:
    """Of 461 min in which nothing ran, 0.2 min after the last cycle were the evidence."""
    ledger.write(by_hand()[:1])
    (shift,) = shift_losses(ledger, LedgerQuery(), BEGINS, at(6, 17), 30.0)
    (off,) = (x for x in shift.losses if x.text == "not running")
    assert (minutes_of(shift)[OFF], off.evidence) == (11.0, "no cycle is listed")


# --- a simulated week ---------------------------------------------------------------------------

IDEAL_S = 180.0
#: What is hidden in each of five shifts: cause → how often, of 1 cycle, in the mean.
HIDDEN: tuple[dict[str, float], ...] = (
    {"added mass": 0.2, "hold": 0.02},
    {"scrap": 0.15, "downstream": 0.1},
    {"wear": 1.0, "off": 0.01},
    {"fault": 0.03, "stop": 0.02},
    {"start": 0.1, "fault": 0.01, "added mass": 0.05},
)
REASONS = {"added mass": (Outcome.MISSED, MISSED), "scrap": (Outcome.REJECTED, "no fit: 3.1 mm")}


class Week:
    """A line that runs from Monday to Friday; it keeps the true cause of each second itself."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self.entries: list[LedgerEntry] = []
        self.truth: list[dict[tuple[str, str], float]] = []
        self._waited: dict[str, float] = {}
        for day, hidden in enumerate(HIDDEN):
            self.truth.append(defaultdict(float))
            self._now = at(24 * day + 6)
            self._spend(OFF, self._seconds(180, 600))
            while self._now < at(24 * day + 13.7) or "reset" in self._waited:
                self._between(hidden)
                self._cycle(hidden, (self._now - at(24 * day + 6)) / timedelta(hours=8))
            self._spend(OFF, (at(24 * day + 14) - self._now).total_seconds())
            self._waited = {}

    def _seconds(self, low: float, high: float) -> float:
        return float(self._random.uniform(low, high))

    def _happens(self, hidden: dict[str, float], what: str, drift: float = 1.0) -> bool:
        return bool(self._random.random() < hidden.get(what, 0.0) * drift)

    def _spend(self, cause: tuple[str, str], seconds: float) -> float:
        self.truth[-1][cause] += seconds
        self._now += timedelta(seconds=seconds)
        return seconds

    def _wait(self, name: str, seconds: float) -> float:
        stops = {"acknowledgement": ("stopped", "stop")}
        self._waited[name] = self._waited.get(name, 0.0) + seconds
        return self._spend(stops.get(name, ("waiting", name)), seconds)

    def _between(self, hidden: dict[str, float]) -> None:
        if self._happens(hidden, "off"):
            self._spend(OFF, self._seconds(60, 600))
        else:
            self._spend(("slower", ""), self._seconds(0.1, 0.4))
        if self._happens(hidden, "stop"):  # in Idle: no cycle tells of it
            self._wait("start", self._seconds(30, 300))
            self._wait("acknowledgement", self._seconds(20, 200))
            self._wait("reset", self._seconds(5, 60))

    def _cycle(self, hidden: dict[str, float], drift: float) -> None:
        number, states = len(self.entries), {"execute": 0.0}
        long = self._happens(hidden, "start")
        states["idle"] = self._wait("start", self._seconds(120, 600) if long else 1.0)
        if self._happens(hidden, "hold"):
            states["held"] = self._wait("unhold", self._seconds(60, 300))
        if self._happens(hidden, "downstream"):
            states["suspended"] = self._wait("downstream", self._seconds(20, 120))
        work_s = IDEAL_S + self._seconds(0.0, 0.2) + drift * 6.0 * hidden.get("wear", 0.0)
        failed, result = self._happens(hidden, "fault"), {}
        spoilt = next((c for c in REASONS if self._happens(hidden, c, 2.0 * drift)), None)
        if failed:
            cause, outcome = ("stopped", "arm.lost"), Outcome.FAILED
            result["fault"] = Fault("execute", "the arm is lost", "arm", code="arm.lost")
        elif spoilt is not None:
            outcome, result["reason"] = REASONS[spoilt]
            cause = outcome.value, str(result["reason"]).replace("0.42", "…").replace("3.1", "…")
        else:
            cause, outcome = ("inserted", ""), Outcome.INSERTED
            self._spend(("slower", ""), work_s - IDEAL_S)
        self._spend(cause, IDEAL_S if outcome is Outcome.INSERTED else work_s)
        states["execute"] = work_s
        entry = cycle(number, self._now, outcome, states, self._waited, **result)
        self._waited = {}
        if failed:
            self._waited["acknowledgement"] = self._spend(cause, self._seconds(60, 900))
            entry = replace(entry, acknowledged=Acknowledgement(self._now, "Ada"))
            self._wait("reset", self._seconds(5, 60))
        self.entries.append(entry)


@pytest.mark.parametrize("seed", [1, 2])
def test_of_a_week_each_cause_gets_its_minutes_and_no_other_any(ledger: Ledger, seed: int) -> None:
    week = Week(seed)
    ledger.write(week.entries)
    found = shift_losses(ledger, LedgerQuery(), BEGINS, at(24 * 7), IDEAL_S)
    assert [shift.begin for shift in found] == [at(24 * day + 6) for day in range(5)]
    for shift, truth in zip(found, week.truth, strict=True):
        minutes = minutes_of(shift) | {("inserted", ""): shift.productive.total_seconds() / 60.0}
        assert minutes == pytest.approx({cause: s / 60.0 for cause, s in truth.items()}, rel=0.1)
        lost = sum((x.lasted for x in shift.losses), shift.productive)
        assert lost == shift.planned == timedelta(hours=8)
    whole = merged(found)
    assert len({(x.kind, x.reason) for x in whole}) == len(whole)
    assert sum((x.lasted for x in whole), timedelta()) == sum(
        (x.lasted for s in found for x in s.losses), timedelta()
    )
    (wear,) = [x for x in found[2].losses if x.kind == "slower"]
    assert wear.evidence.startswith("slowest steps, per cable: identify +")


# --- what a learned model would have inserted ----------------------------------------------------


@pytest.mark.parametrize(("passed", "cables"), [(0, 3), (6, 7), (5, 5)])
def test_a_share_has_the_exact_interval(passed: int, cables: int) -> None:
    share = PassingShare.of("air_drag", passed, cables)
    exact = binomtest(passed, cables).proportion_ci(0.95, "exact")
    assert (share.low, share.high) == pytest.approx((exact.low, exact.high))
    with pytest.raises(ValueError, match="give 0 ≤ passed ≤ cables"):
        PassingShare.of("air_drag", 1, 0)


@pytest.mark.parametrize(
    ("model", "forecasts", "said"),
    [
        ("abc", [("00002", 1e-4), ("00003", 1e-4)], "with air_drag 1 of 1 forecasts pass"),
        ("abc", [("00002", None)], "with air_drag 0 of 1 forecasts pass (0% to 98%)"),
        ("other", [("00002", 1e-4)], ""),
        ("abc", [("00003", 1e-4)], ""),
    ],
    ids=["passes", "fails", "of another model", "of an inserted cable only"],
)
def test_a_candidate_says_which_share_of_missed_cables_it_would_have_inserted(
    ledger: Ledger, tmp_path: Path, model: str, forecasts: list[tuple[str, float]], said: str
) -> None:
    ledger.write(by_hand())
    path, settings = tmp_path / "candidate.yaml", load_settings(Path("config/fake.yaml"))
    content = {
        "format": "cell-candidate/1",
        "beside": model,
        "model": {"effects": [{"effect": "air_drag"}]},
        "gates": [],
        "forecasts": [{"cycle": name, "candidate_m": error} for name, error in forecasts],
    }
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    candidate = read_forecasts(path, settings, ledger)
    (shift,) = shift_losses(ledger, LedgerQuery(), BEGINS, at(7, 10), 30.0, candidate=candidate)
    (missed,) = [x for x in shift.losses if x.kind == "missed"]
    assert missed.physics.startswith(said) and bool(missed.physics) is bool(said)
    path.write_text(yaml.safe_dump(content | {"forecasts": [{}]}), encoding="utf-8")
    with pytest.raises(InputError, match="need cycle and candidate_m"):
        read_forecasts(path, settings, ledger)
