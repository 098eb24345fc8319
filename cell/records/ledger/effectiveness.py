"""Overall equipment effectiveness (OEE) per shift: availability × performance × quality."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, time, timedelta
from typing import Any

from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.records.result import Outcome

#: Quantile of the insertion times that is the ideal cycle, where none is configured.
QUICK = 0.1


@dataclass(frozen=True)
class Shift:
    """Times and counts of a line in one shift.  Shares are None where they are undefined: 0 / 0.

    planned_s      length of the shift, up to now: planned busy time (PBT)
    running_s      time at work on cables: actual production time (APT)
    ideal_s        time that one cable needs at best: planned run time per item (PRI)
    availability   running_s / planned_s; None also where simulated time was quicker than the clock
    performance    ideal_s × cables / running_s, at most 1: a rejected cable needs less than ideal_s
                   (ISO: effectiveness)
    quality        inserted / cables: quality ratio, good / produced quantity (GQ / PQ)
    cables         whose cycle has ended, but not by a commanded stop
    source         ISO 22400-2:2014, key performance indicators for manufacturing operations
    """

    begin: datetime
    end: datetime
    planned_s: float
    running_s: float
    ideal_s: float | None
    cables: int
    inserted: int

    @property
    def availability(self) -> float | None:
        """Share of the planned time at work."""
        share = _share(self.running_s, self.planned_s)
        return None if share is None or share > 1.0 else share

    @property
    def performance(self) -> float | None:
        """Ideal time over actual time of the cables."""
        share = _share((self.ideal_s or 0.0) * self.cables, self.running_s)
        return None if self.ideal_s is None or share is None else min(share, 1.0)

    @property
    def quality(self) -> float | None:
        """Share of the cables that were inserted."""
        return _share(self.inserted, self.cables)

    @property
    def oee(self) -> float | None:
        """The product of the three."""
        a, p, q = self.availability, self.performance, self.quality
        return None if a is None or p is None or q is None else a * p * q

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        shares = ("availability", "performance", "quality", "oee")
        return {
            **vars(self),
            "begin": self.begin.isoformat(),
            "end": self.end.isoformat(),
            **{name: getattr(self, name) for name in shares},
        }


def shifts(
    ledger: Ledger,
    wanted: LedgerQuery,
    begins: Sequence[time],
    now: datetime,
    ideal_s: float | None = None,
) -> list[Shift]:
    """Shifts with cables, oldest first.

    begins   when shifts begin, of every day, in local time
    now      with a time zone
    ideal_s  of one cable; None = time of the quickest tenth of the insertions
    raises   LedgerError
    """
    span = ledger.span(wanted)
    if span is None:
        return []
    if ideal_s is None:
        ideal_s = ledger.quick_cycle_s(wanted, QUICK)
    listed = []
    for begin, end in shift_bounds(span[0], min(span[1], now), begins):
        since = begin if wanted.since is None else max(begin, wanted.since)
        until = end if wanted.until is None else min(end, wanted.until)
        outcomes, running_s = ledger.work(replace(wanted, since=since, until=until))
        if not outcomes:
            continue
        planned_s = (min(until, now) - since).total_seconds()
        cables, inserted = sum(outcomes.values()), outcomes.get(Outcome.INSERTED.value, 0)
        listed.append(Shift(since, until, planned_s, running_s, ideal_s, cables, inserted))
    return listed


def shift_start(begins: Sequence[time], now: datetime) -> datetime:
    """Beginning of the current shift; `begins` of every day, local time."""
    days = (now.date() - timedelta(days=1), now.date())
    marks = [datetime.combine(day, begin).astimezone() for day in days for begin in begins]
    return max(m for m in marks if m <= now)


def shift_bounds(
    first: datetime, last: datetime, begins: Sequence[time]
) -> list[tuple[datetime, datetime]]:
    """Beginning and end of every shift from that of `first` to that of `last`."""
    day = first.astimezone().date() - timedelta(days=1)
    marks = []
    while day <= last.astimezone().date() + timedelta(days=1):
        marks += [datetime.combine(day, begin).astimezone() for begin in sorted(begins)]
        day += timedelta(days=1)
    pairs = itertools.pairwise(marks)
    return [(begin, end) for begin, end in pairs if end > first and begin <= last]


def _share(part: float, total: float) -> float | None:
    return part / total if total > 0.0 else None
