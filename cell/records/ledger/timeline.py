"""Timeline of a line without gaps, from the ledger's cycles: its activity at every moment."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum

from cell.records.ledger.entry import RUNNING
from cell.records.ledger.ledger import ListedCycle
from cell.records.result import Outcome

#: Longest time of the program's work between two cycles, s: in a longer time without entries it
#: did not run.
BETWEEN_S = 10.0
#: Agreement of the clocks of acknowledgements and of waits, s.
_CLOCKS_S = 1.0
_NUMBER = re.compile(r"[+\-−]?\d+(?:\.\d+)?")
_ACKNOWLEDGEMENT, _RESET, _START = "acknowledgement", "reset", "start"
#: Wait reasons of states with a single reason, unless a suspended cell has a different one.
_PAUSES = {
    **dict.fromkeys(("holding", "held", "unholding"), "unhold"),
    **dict.fromkeys(("suspending", "suspended", "unsuspending"), "unsuspend"),
}
_NAMED = frozenset({_ACKNOWLEDGEMENT, _RESET, _START, *_PAUSES.values()})


class LossKind(StrEnum):
    """Why time was lost.

    waiting, not running   actual unit down time (ADOT): available, but executing no order
    stopped                actual unit delay time (ADET): interrupted by a fault or a stop, until a
                           person has acknowledged it
    rejected, missed       actual production time (APT) of scrap (SQ)
    slower                 APT of good cables (GQ) beyond the planned run time per item (PRI), the
                           ideal cycle; and the time between two cycles
    other                  cycles that were to insert nothing: measured, or a dry run
    unfinished             a cycle without a result: under way, or broken off

    source  ISO 22400-2:2014, time elements of work units; it has no name for the last two
    """

    WAITING = "waiting"
    STOPPED = "stopped"
    REJECTED = "rejected"
    MISSED = "missed"
    SLOWER = "slower"
    OTHER = "other"
    UNFINISHED = "unfinished"
    NOT_RUNNING = "not running"


#: Kind and reason; None = the ideal cycle of an inserted cable.  A reason is that of a wait, a
#: fault's code, or why a cable was rejected or missed, with its numbers as "…".
Cause = tuple[LossKind, str] | None
#: Of a cycle, s: kind (state, step, waiting) → name, as of `Ledger.times`.
CycleTimes = Mapping[str, Mapping[str, float]]
_UNKNOWN: CycleTimes = {}


@dataclass(frozen=True)
class Segment:
    """A time that has one cause.

    cycle  that it belongs to, or that the wait precedes; None = there is none yet
    """

    begin: datetime
    end: datetime
    cause: Cause
    cycle: ListedCycle | None = None


def timeline(
    cycles: Sequence[ListedCycle],
    times: Mapping[str, CycleTimes],
    ideal_s: float,
    now: datetime,
    waits_now: Mapping[str, float],
) -> Iterator[Segment]:
    """Segments from a line's first cycle until now, one after the other.

    cycles     of one line, oldest first
    times      by their `uid`
    waits_now  s since the last cycle, by reason
    """
    previous: ListedCycle | None = None
    at = now
    for cycle, following in zip(cycles, [*cycles[1:], None], strict=False):
        of = times.get(cycle.uid, _UNKNOWN)
        begin = cycle.started
        if cycle.ended is None:
            end = now if following is None else begin + timedelta(seconds=ideal_s)
        else:
            end = cycle.ended
            if spent := of.get("state"):
                begin = end - timedelta(seconds=sum(spent.values()))
        if previous is not None:
            begin = max(begin, at)
            yield from _between(previous, cycle, at, begin, _waited_before(of))
        end = max(begin, end)  # the clock may have been set back
        yield from _split(begin, end, _parts(cycle, of, ideal_s), cycle)
        previous, at = cycle, end
    if previous is not None and at < now:
        yield from _between(previous, None, at, now, waits_now)


def _parts(cycle: ListedCycle, of: CycleTimes, ideal_s: float) -> Iterator[tuple[Cause, float]]:
    """Causes within a cycle, and their durations, s."""
    if cycle.ended is None:
        yield (LossKind.UNFINISHED, ""), 1.0
        return
    lasted_s = max(0.0, (cycle.ended - cycle.started).total_seconds())
    spent = dict(of.get("state") or {"execute": lasted_s})
    yield (LossKind.WAITING, _START), spent.pop("idle", 0.0)
    named = {name: s for name, s in of.get("waiting", {}).items() if name not in _NAMED and s > 0.0}
    for state, usual in _PAUSES.items():
        paused_s = spent.pop(state, 0.0)
        reasons = named if named and usual == "unsuspend" else {usual: 1.0}
        for reason, share in reasons.items():
            yield (LossKind.WAITING, reason), paused_s * share / sum(reasons.values())
    working_s = sum(s for state, s in spent.items() if state in RUNNING)
    stopping_s = sum(spent.values()) - working_s
    if cycle.outcome == Outcome.INSERTED:
        yield None, min(working_s, ideal_s)
        yield (LossKind.SLOWER, ""), max(0.0, working_s - ideal_s) + stopping_s
    else:
        yield _cause_of(cycle), working_s + stopping_s


def _cause_of(cycle: ListedCycle) -> Cause:
    """Why the work on a cable that was not inserted is lost."""
    if cycle.fault is not None:
        return LossKind.STOPPED, cycle.fault.code
    if cycle.outcome in (Outcome.REJECTED, Outcome.MISSED):
        return LossKind(cycle.outcome), _NUMBER.sub("…", cycle.reason or "")
    return LossKind.OTHER, cycle.outcome


def _waited_before(of: CycleTimes) -> dict[str, float]:
    """Waits between the previous cycle and this one, by reason, s; empty = not known."""
    waited, idle_s = of.get("waiting", {}), of.get("state", {}).get("idle", 0.0)
    if not waited:
        return {}
    before_s = {name: waited.get(name, 0.0) for name in (_ACKNOWLEDGEMENT, _RESET)}
    return {_START: max(0.0, waited.get(_START, 0.0) - idle_s), **before_s}


def _between(
    previous: ListedCycle,
    following: ListedCycle | None,
    begin: datetime,
    end: datetime,
    waited: Mapping[str, float],
) -> Iterator[Segment]:
    """Causes of the time after a cycle; `waited` during it, s: empty = not known.

    A fault stops the cell until it is acknowledged.
    """
    fault, ack = previous.fault, previous.acknowledged
    if fault is not None:
        until = end if ack is None else min(max(ack.at, begin), end)
        yield Segment(begin, until, (LossKind.STOPPED, fault.code), previous)
        stopped_s = (until - begin).total_seconds()
        begin = until
        if waited:  # of further stops, in Idle
            more_s = waited.get(_ACKNOWLEDGEMENT, 0.0) - stopped_s
            waited = {**waited, _ACKNOWLEDGEMENT: more_s if more_s > _CLOCKS_S else 0.0}
        else:
            waited = {_RESET: (end - begin).total_seconds()}
    remaining_s = (end - begin).total_seconds()
    stop = LossKind.STOPPED, "unfinished" if previous.ended is None else "stop"
    parts: list[tuple[Cause, float]] = []
    for name, waited_s in waited.items():
        taken_s = min(waited_s, remaining_s)
        remaining_s -= taken_s
        parts.append((stop if name == _ACKNOWLEDGEMENT else (LossKind.WAITING, name), taken_s))
    short = remaining_s <= BETWEEN_S and (following is not None or bool(waited))
    rest: Cause = (LossKind.SLOWER if short else LossKind.NOT_RUNNING), ""
    yield from _split(begin, end, [(rest, remaining_s), *parts], following)


def _split(
    begin: datetime,
    end: datetime,
    parts: Iterable[tuple[Cause, float]],
    cycle: ListedCycle | None,
) -> Iterator[Segment]:
    """A time span divided in proportion: simulated time may be quicker than the clock."""
    known = [(cause, lasted_s) for cause, lasted_s in parts if lasted_s > 0.0]
    sums = list(itertools.accumulate(lasted_s for _, lasted_s in known))
    at = begin
    for number, (cause, _) in enumerate(known):
        last = number == len(known) - 1
        until = end if last else begin + (end - begin) * (sums[number] / sums[-1])
        yield Segment(at, until, cause, cycle)
        at = until
