"""Every minute of a shift that did not end in an inserted cable, with its cause and evidence.

Each moment of a shift belongs to one cause or to inserted cables: their times add up to the planned
time of the shift exactly.  A learned model predicts which share of the rejected and missed cables
it would have inserted.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, time, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from cell.files.input_error import InputError
from cell.files.yaml_document import read_yaml
from cell.records.ledger.effectiveness import QUICK, shift_bounds
from cell.records.ledger.ledger import Ledger, LedgerQuery, ListedCycle
from cell.records.ledger.timeline import Cause, CycleTimes, LossKind, Segment, timeline
from cell.records.result import Outcome
from cell.settings.model import Settings
from cell.settings.promotion import read_candidate

#: Latest beginning, after the end of a shift, of a cycle whose wait may reach back into the shift.
_LATER = timedelta(days=7)
_NONE = timedelta(0)
#: Steps that are named as slow: their greatest number, and least mean delay, s.
_SLOW_STEPS, _SLOWER_S = 3, 0.05
#: Confidence of the share's interval.
CONFIDENCE = 0.95
#: Descriptions of wait reasons; others are as the PLC or a person named them.
_WAITS = {
    "start": "a start",
    "part": "a part",
    "upstream": "the machine before",
    "downstream": "the next machine",
    "reset": "a reset",
    "unhold": "a person who has held the cell",
    "unsuspend": "the line",
}


def minutes_in(lasted: timedelta) -> float:
    """A duration in minutes."""
    return lasted.total_seconds() / 60.0


@dataclass(frozen=True)
class PassingShare:
    """Share of cables whose tip the learned model forecast within the opening, with its interval.

    effects         of the model
    passed, cables  forecasts within the opening, and all: each of a cable that the former model
                    rejected or missed, from that cable's own hold, held out of the fit
    low, high       95 % interval
    source          Clopper & Pearson 1934, Biometrika 26, 404
    """

    effects: str
    passed: int
    cables: int
    low: float
    high: float

    @classmethod
    def of(cls, effects: str, passed: int, cables: int) -> PassingShare:
        """Share with the exact interval of a binomial.  Raises ValueError: 0 cables."""
        from scipy.special import betaincinv

        if not 0 <= passed <= cables or not cables:
            raise ValueError(f"{passed} of {cables} cables is no share; give 0 ≤ passed ≤ cables")
        tail, failed = 0.5 * (1.0 - CONFIDENCE), cables - passed
        low = float(betaincinv(passed, failed + 1, tail)) if passed else 0.0
        high = float(betaincinv(passed + 1, failed, 1.0 - tail)) if failed else 1.0
        return cls(effects, passed, cables, low, high)

    def __str__(self) -> str:
        return (
            f"with {self.effects} {self.passed} of {self.cables} forecasts pass "
            f"({self.low:.0%} to {self.high:.0%})"
        )

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {**asdict(self), "share": self.passed / self.cables}


@dataclass(frozen=True)
class CandidateForecasts:
    """Forecasts of recorded cables by a model of `cell learn`.

    model   hash of the model that the line had when it was learned
    counts  outcome → forecasts within the opening, and all
    """

    effects: str
    model: str
    counts: Mapping[str, tuple[int, int]]

    def share(self, cycles: Sequence[ListedCycle]) -> PassingShare | None:
        """Share of cycles of one outcome; None = unknown: other model, or no forecast."""
        outcomes = {c.outcome for c in cycles}
        if {c.model for c in cycles} != {self.model} or len(outcomes) != 1:
            return None
        passed, cables = self.counts.get(outcomes.pop(), (0, 0))
        return PassingShare.of(self.effects, passed, cables) if cables else None


def read_forecasts(path: Path, settings: Settings, ledger: Ledger) -> CandidateForecasts:
    """Forecasts in a candidate's file, of cycles that the ledger lists as rejected or missed.

    settings  of the opening, within half of whose height the tip must be forecast
    raises    InputError: the file is no candidate, or its forecasts are damaged; LedgerError
    """
    candidate = read_candidate(path)
    document = read_yaml(path)
    try:
        errors_m = {
            str(f["cycle"]): float("inf") if f["candidate_m"] is None else float(f["candidate_m"])
            for f in document.data.get("forecasts", [])
        }
    except (TypeError, KeyError, ValueError) as error:
        message = "need cycle and candidate_m in metres; learn it again"
        raise InputError([document.problem(("forecasts",), message)]) from error
    low_m, high_m = settings.destination.y_m
    outcomes = (Outcome.REJECTED.value, Outcome.MISSED.value)
    counts: dict[str, tuple[int, int]] = {}
    for cycle in ledger.listed(LedgerQuery(model=candidate.baseline, outcomes=outcomes)):
        if cycle.folder.name in errors_m:
            passed, cables = counts.get(cycle.outcome, (0, 0))
            passes = errors_m[cycle.folder.name] < 0.5 * (high_m - low_m)
            counts[cycle.outcome] = passed + passes, cables + 1
    names = [Path(effect.effect).stem for effect in candidate.model.effects]
    return CandidateForecasts(" + ".join(names), candidate.baseline, counts)


@dataclass(frozen=True)
class Loss:
    """Time that was lost for one reason.

    reason    as of `Cause`
    cycles    that it belongs to, or that the wait precedes; oldest first
    evidence  newest cause and acknowledgement, longest wait, or slowest steps, as text
    passing   share of these cables that a learned model forecasts to pass; None = unknown
    """

    kind: LossKind
    reason: str
    lasted: timedelta
    cycles: tuple[ListedCycle, ...] = ()
    evidence: str = ""
    passing: PassingShare | None = None

    @property
    def text(self) -> str:
        """Short text of the cause."""
        match self.kind:
            case LossKind.WAITING:
                return f"waiting for {_WAITS.get(self.reason, self.reason)}"
            case LossKind.STOPPED:
                return f"stopped: {self.reason}"
            case LossKind.SLOWER:
                return "slower than the ideal cycle"
            case LossKind.OTHER:
                return f"cycles of another kind: {self.reason}"
            case LossKind.UNFINISHED:
                return "a cycle under way or broken off"
            case _:
                return self.kind.value

    @property
    def physics(self) -> str:
        """Text of the share of these cables that a learned model would have inserted; may be ""."""
        return "" if self.passing is None else str(self.passing)

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "cause": self.kind.value,
            "reason": self.reason,
            "minutes": minutes_in(self.lasted),
            "evidence": self.evidence,
            "passing": None if self.passing is None else self.passing.to_json(),
            "cycles": [str(cycle.folder) for cycle in self.cycles],
        }


@dataclass(frozen=True)
class ShiftLosses:
    """Where the time of a line's shift went: `productive` and all losses add up to `planned`.

    productive  ideal cycle times (planned run time per item, PRI) of inserted cables
    inserted    cables whose cycle began in the shift
    losses      the longest first
    """

    line: str
    begin: datetime
    end: datetime
    productive: timedelta
    inserted: int
    losses: tuple[Loss, ...]

    @property
    def planned(self) -> timedelta:
        """Planned busy time (PBT): length of the shift, up to now."""
        return self.end - self.begin

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "line": self.line,
            "begin": self.begin.isoformat(),
            "end": self.end.isoformat(),
            "planned_minutes": minutes_in(self.planned),
            "inserted_minutes": minutes_in(self.productive),
            "inserted": self.inserted,
            "losses": [loss.to_json() for loss in self.losses],
            "failures": [one.to_json() for one in failure_times([self])],
        }


@dataclass(frozen=True)
class FailureTimes:
    """Failures of one reason code: how often they come, and how long each stops the line.

    mtbf  mean operating time between failures: planned time that is neither stopped nor switched
          off, divided by the number of failures
    mttr  mean time to restoration: stopped time divided by that number

    source  IEC 60050-192:2015, 192-05-13 and 192-07-23
    """

    code: str
    failures: int
    mtbf: timedelta
    mttr: timedelta

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "code": self.code,
            "failures": self.failures,
            "mtbf_minutes": minutes_in(self.mtbf),
            "mttr_minutes": minutes_in(self.mttr),
        }


def failure_times(shifts: Sequence[ShiftLosses]) -> list[FailureTimes]:
    """Failures in these shifts by reason code, the most frequent first; each counts once."""
    down = (LossKind.STOPPED, LossKind.NOT_RUNNING)
    planned = sum((s.planned for s in shifts), _NONE)
    losses = merged(shifts)
    operating = planned - sum((x.lasted for x in losses if x.kind in down), _NONE)
    failures = [
        FailureTimes(x.reason, n, operating / n, x.lasted / n)
        for x in losses
        if x.kind is LossKind.STOPPED and (n := len(x.cycles))
    ]
    return sorted(failures, key=lambda failure: (-failure.failures, failure.code))


def shift_losses(
    ledger: Ledger,
    wanted: LedgerQuery,
    begins: Sequence[time],
    now: datetime,
    ideal_s: float | None = None,
    *,
    candidate: CandidateForecasts | None = None,
    waits_now: Mapping[str, float] | None = None,
) -> list[ShiftLosses]:
    """Losses of every shift of every line, oldest first, without shifts in which nothing ran.

    wanted     its times and its line
    begins, now, ideal_s  as of `shifts`
    candidate  forecasts of recorded cables by a learned model
    waits_now  as of `timeline`
    raises     LedgerError
    """
    wanted = LedgerQuery(since=wanted.since, until=wanted.until, line=wanted.line)
    span = ledger.span(LedgerQuery(line=wanted.line))
    if span is None:
        return []
    if ideal_s is None:
        ideal_s = ledger.quick_cycle_s(wanted, QUICK) or 0.0
    last = now if wanted.until is None else min(wanted.until, now)
    first = max(span[0], wanted.since or span[0])
    bounds = [
        (max(begin, wanted.since or begin), min(end, last))
        for begin, end in shift_bounds(first, last, begins)
        if begin < last
    ]
    losses: list[ShiftLosses] = []
    lines = [wanted.line] if wanted.line else {c.line for c in ledger.listed(wanted) if bounds}
    for line in lines if bounds else ():
        of_line = replace(wanted, line=line, since=bounds[0][0], until=bounds[-1][1])
        cycles, times = _with_neighbours(ledger, of_line)
        segments = list(timeline(cycles, times, ideal_s, now, waits_now or {}))
        losses += [_shift(line, *bound, segments, times, candidate) for bound in bounds]
    off = {LossKind.NOT_RUNNING}
    ran = [s for s in losses if s.productive or {loss.kind for loss in s.losses} != off]
    return sorted(ran, key=lambda shift: (shift.begin, shift.line))


def merged(shifts: Sequence[ShiftLosses]) -> list[Loss]:
    """Losses of several shifts, one of each kind and reason, the longest first.

    The evidence is that of the newest shift; the share of a learned model is kept if all have it.
    """
    by_cause: dict[tuple[LossKind, str], list[Loss]] = {}
    for loss in (loss for shift in shifts for loss in shift.losses):
        by_cause.setdefault((loss.kind, loss.reason), []).append(loss)
    losses = []
    for same in by_cause.values():
        lasted = sum((loss.lasted for loss in same), _NONE)
        cycles = tuple({c.uid: c for loss in same for c in loss.cycles}.values())
        passing = same[-1].passing if len({loss.passing for loss in same}) == 1 else None
        losses.append(replace(same[-1], lasted=lasted, cycles=cycles, passing=passing))
    return sorted(losses, key=lambda loss: -loss.lasted)


def _with_neighbours(
    ledger: Ledger, of_line: LedgerQuery
) -> tuple[list[ListedCycle], dict[str, CycleTimes]]:
    """Cycles with their times; also the ones before and after: either may reach into the shift."""
    assert of_line.since is not None and of_line.until is not None
    before = ledger.listed(replace(of_line, since=None, until=of_line.since), 1)
    later = replace(of_line, since=of_line.until, until=of_line.until + _LATER)
    after = ledger.listed(later)[:1]
    cycles = [*before, *ledger.listed(of_line), *after]
    since = min([of_line.since, *(c.started for c in before)])
    until = max([of_line.until, *(c.started + timedelta(seconds=1) for c in after)])
    return cycles, dict(ledger.times(replace(of_line, since=since, until=until)))


def _shift(
    line: str,
    begin: datetime,
    end: datetime,
    segments: Iterable[Segment],
    times: Mapping[str, CycleTimes],
    candidate: CandidateForecasts | None,
) -> ShiftLosses:
    """Segments within a shift, by cause; in the rest of the shift nothing ran."""
    inside: dict[Cause, list[Segment]] = {}
    for s in segments:
        if max(s.begin, begin) < min(s.end, end):
            clipped = replace(s, begin=max(s.begin, begin), end=min(s.end, end))
            inside.setdefault(s.cause, []).append(clipped)
    rest = end - begin - _duration(itertools.chain.from_iterable(inside.values()))
    productive = inside.pop(None, [])
    off = LossKind.NOT_RUNNING, ""
    if rest > _NONE and off not in inside:
        inside[off] = []
    quick_s = _quick_steps_s(_cycles_of(productive), times)
    losses = []
    for cause, parts in inside.items():
        assert cause is not None
        kind, reason = cause
        cycles = () if cause == off else _cycles_of(parts)
        if kind is LossKind.SLOWER:
            cycles = tuple(c for c in cycles if c.outcome == Outcome.INSERTED)
        lasted = _duration(parts) + (rest if cause == off else _NONE)
        evidence = _slow_steps(cycles, times, quick_s) if kind is LossKind.SLOWER else ""
        if cause == off and rest > max((s.end - s.begin for s in parts), default=_NONE):
            evidence = "no cycle is listed"
        evidence = evidence or _evidence(kind, parts, cycles)
        judged = candidate if kind in (LossKind.REJECTED, LossKind.MISSED) else None
        passing = None if judged is None else judged.share(cycles)
        losses.append(Loss(kind, reason, lasted, cycles, evidence, passing))
    losses.sort(key=lambda loss: -loss.lasted)
    inserted = sum(begin <= c.started < end for c in _cycles_of(productive))
    return ShiftLosses(line, begin, end, _duration(productive), inserted, tuple(losses))


def _duration(segments: Iterable[Segment]) -> timedelta:
    return sum((s.end - s.begin for s in segments), _NONE)


def _cycles_of(segments: Iterable[Segment]) -> tuple[ListedCycle, ...]:
    return tuple({s.cycle.uid: s.cycle for s in segments if s.cycle is not None}.values())


def _evidence(kind: LossKind, parts: Sequence[Segment], cycles: Sequence[ListedCycle]) -> str:
    """Evidence for a cause, as text: of its newest cycle, or its longest time."""
    newest = cycles[-1] if cycles else None
    if kind in (LossKind.REJECTED, LossKind.MISSED) and newest is not None:
        return newest.reason or ""
    if kind is LossKind.STOPPED and newest is not None and newest.fault is not None:
        ack = newest.acknowledged
        if ack is None:
            return f"{newest.fault.cause}; not acknowledged"
        note = f": {ack.note}" if ack.note else ""
        at = ack.at.astimezone()
        return f"{newest.fault.cause}; acknowledged by {ack.by} at {at:%m-%d %H:%M}{note}"
    longest = max(parts, key=lambda s: s.end - s.begin)
    minutes = minutes_in(longest.end - longest.begin)
    return f"at most {minutes:.1f} min at a time, from {longest.begin.astimezone():%m-%d %H:%M}"


def _quick_steps_s(
    cycles: Sequence[ListedCycle], times: Mapping[str, CycleTimes]
) -> dict[str, float]:
    """Time of each step in the quickest tenth of these cycles, s."""
    seconds: dict[str, list[float]] = {}
    for cycle in cycles:
        for step, spent_s in times.get(cycle.uid, {}).get("step", {}).items():
            seconds.setdefault(step, []).append(spent_s)
    return {step: float(np.quantile(spent, QUICK)) for step, spent in seconds.items()}


def _slow_steps(
    cycles: Sequence[ListedCycle],
    times: Mapping[str, CycleTimes],
    quick_s: Mapping[str, float],
) -> str:
    """Text of the steps that exceeded the time of the quickest tenth most."""
    slower: dict[str, float] = dict.fromkeys(quick_s, 0.0)
    for cycle in cycles:
        for step, spent_s in times.get(cycle.uid, {}).get("step", {}).items():
            if step in slower:
                slower[step] += (spent_s - quick_s[step]) / len(cycles)
    slowest = sorted(slower.items(), key=lambda item: -item[1])[:_SLOW_STEPS]
    named = [f"{step} +{s:.1f} s" for step, s in slowest if s > _SLOWER_S]
    return f"slowest steps, per cable: {', '.join(named)}" if named else ""
