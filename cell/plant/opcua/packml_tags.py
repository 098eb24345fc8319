"""Variables of a unit that PackML names: state machines, status and admin tags."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection
from datetime import UTC, datetime
from typing import Any

from cell.plant.messages import Status
from cell.plant.opcua import packml
from cell.plant.opcua.machines import MACHINE_PATHS, MACHINES, active_states, number_of
from cell.plant.opcua.tag import NO_CELL, NO_DATA, NOT_ACTIVE, Tag, Value, of, of_view
from cell.plant.opcua.view import PackmlView, PastFault
from cell.records.result import Outcome
from cell.run.machine import CellState

_PROPERTY = "HasProperty"
_NEVER = datetime(1601, 1, 1, tzinfo=UTC)

#: Cycles with these outcomes used a cable up without inserting it.
DEFECTIVE = (Outcome.MISSED, Outcome.REJECTED, Outcome.FAILED)
#: States that end by themselves.
ACTING = frozenset(s for s in CellState if s.value.endswith("ing")) | {CellState.EXECUTE}


def machine_tags(level: int) -> tuple[Tag, ...]:
    """Variables of a state machine, 0 = the outermost: its state, and what led there."""
    path, machine = MACHINE_PATHS[level], MACHINES[level]
    ids = {s.name: s.id for s in machine.states}
    numbers = {s.name: s.number for s in machine.states}
    states, transitions = tuple(ids.values()), tuple(t.id for t in machine.transitions)
    current, last = f"{path}.CurrentState", f"{path}.LastTransition"
    of_state, of_last = "FiniteStateVariableType", "FiniteTransitionVariableType"
    return (
        Tag(
            current, "LocalizedText", "active state", _state(level, str), True, definition=of_state
        ),
        Tag(f"{current}.Id", "NodeId", "its node", _state(level, ids.get), True, _PROPERTY),
        Tag(
            f"{current}.Number", "UInt32", "its number", _state(level, numbers.get), True, _PROPERTY
        ),
        Tag(last, "LocalizedText", "newest transition", _last(level, 0), True, definition=of_last),
        Tag(f"{last}.Id", "NodeId", "its node", _last(level, 1), True, _PROPERTY),
        Tag(f"{path}.AvailableStates", "NodeId[]", "all states", lambda v, t: states, True),
        Tag(
            f"{path}.AvailableTransitions",
            "NodeId[]",
            "all transitions",
            lambda v, t: transitions,
            True,
        ),
    )


def _state(level: int, read: Callable[[str], Any]) -> Value:
    def value(view: PackmlView, now_s: float) -> Any:
        if not view.connected or view.status is None:
            return NO_CELL
        active = active_states(view.status.state)
        return read(active[level]) if level < len(active) else NOT_ACTIVE

    return value


def _last(level: int, item: int) -> Value:
    def value(view: PackmlView, now_s: float) -> Any:
        if not view.connected:
            return NO_CELL
        found = view.transitions.get(level, (None, None))[item]
        return NO_DATA if found is None else found

    return value


def _speed(view: PackmlView) -> float | None:
    """Cables per minute, as the last cycle took; 0 while nothing moves."""
    if view.status is None:
        return None
    moves = view.status.state in ACTING
    return 60.0 / view.cycle_s if moves and view.cycle_s else 0.0


def _product(status: Status) -> tuple[tuple[Any, ...], ...]:
    """Number of the product among those of the cell, from 1."""
    if status.product not in status.products:
        return ()
    return ((status.products.index(status.product) + 1, [], []),)


def _count(name: str, outcomes: Collection[str]) -> Value:
    def count(status: Status) -> tuple[tuple[Any, ...], ...]:
        number = sum(n for outcome, n in status.counts.items() if outcome in outcomes)
        return ((0, name, None, number, number),)

    return of(count)


def _alarm(past: PastFault) -> tuple[Any, ...]:
    """As a structure: number of the kind of fault, cycle, text, 1 = of a device."""
    fault = past.fault
    text = f"{fault.cause}; {fault.remedy}" if fault.remedy else fault.cause
    number = zlib.crc32(fault.code.encode()) & 0x7FFFFFFF
    category = 0 if fault.device is None else 1
    at, open_ = datetime.fromtimestamp(fault.time_s, UTC), past.acknowledged_s is None
    seen = datetime.fromtimestamp(past.acknowledged_s, UTC) if past.acknowledged_s else _NEVER
    return (number, fault.cycle, text, category, at, seen, open_)


def _alarms(view: PackmlView) -> tuple[tuple[Any, ...], ...]:
    """Faults that nobody has acknowledged."""
    known = view.status is not None and view.status.fault is not None
    return tuple(_alarm(p) for p in view.faults[:1] if p.acknowledged_s is None and known)


def _by_mode(seconds: Callable[[PackmlView, float], int]) -> Value:
    """A time for each mode, s."""

    def value(view: PackmlView, now_s: float) -> Any:
        if view.status is None:
            return NO_DATA
        mode = packml.MODE_NUMBERS[view.status.mode]
        return [seconds(view, now_s) if n == mode else 0 for n in range(len(packml.MODE_NAMES))]

    return value


def _by_state(seconds: Callable[[PackmlView, float], dict[CellState, float]]) -> Value:
    """A time for each mode and state, s: rows are modes, columns numbers of states."""

    def value(view: PackmlView, now_s: float) -> Any:
        if view.status is None:
            return NO_DATA
        columns = 1 + max(map(number_of, CellState))
        rows = [[0] * columns for _ in packml.MODE_NAMES]
        for state, spent_s in seconds(view, now_s).items():
            rows[packml.MODE_NUMBERS[view.status.mode]][number_of(state)] = int(spent_s)
        return rows

    return value


def _total(view: PackmlView, now_s: float) -> int:
    return int(sum(view.seconds_at(now_s).values()))


def _all_states(view: PackmlView, now_s: float) -> dict[CellState, float]:
    return {CellState(s): spent_s for s, spent_s in view.seconds_at(now_s).items()}


def _this_state(view: PackmlView, now_s: float) -> dict[CellState, float]:
    if view.status is None:
        return {}
    return {view.status.state: max(0.0, view.known_s(now_s) - view.entered_s)}


def status_tags(design_per_minute: float | None) -> tuple[Tag, ...]:
    """Status tags.

    design_per_minute  cables that the cell makes at best; None = not said
    """
    speed = of_view(lambda v: design_per_minute)
    return (
        Tag(
            "Status.UnitSupportedModes",
            "NodeId",
            "enumeration of the modes",
            lambda v, t: packml.MODE_ENUM,
            True,
            _PROPERTY,
        ),
        Tag(
            "Status.UnitModeCurrent",
            "Mode",
            "1 production, 2 maintenance, 3 manual",
            of(lambda s: packml.MODE_NUMBERS[s.mode]),
        ),
        Tag(
            "Status.StateChangeInProcess",
            "Boolean",
            "the state ends by itself",
            of(lambda s: s.state in ACTING),
        ),
        Tag(
            "Status.MachSpeed", "Float", "ideal cables/min, by `ledger.ideal_cycle_s`", speed, True
        ),
        Tag("Status.CurMachSpeed", "Float", "cables/min, as the last cycle took", of_view(_speed)),
        Tag(
            "Status.EquipmentBlocked",
            "Boolean",
            "waits for downstream",
            of(lambda s: "downstream" in s.waiting_for),
        ),
        Tag(
            "Status.EquipmentStarved",
            "Boolean",
            "waits for a part or upstream",
            of(lambda s: not {"part", "upstream"}.isdisjoint(s.waiting_for)),
        ),
        Tag(
            "Status.Product",
            "PackMLProductDataType[]",
            "number of the product, from 1",
            of(_product),
        ),
    )


def admin_tags(design_per_minute: float | None) -> tuple[Tag, ...]:
    """Admin tags."""
    alarms, alarm = "PackMLAlarmDataType[]", "PackMLAlarmDataType"
    count, times = "PackMLCountDataType[]", "Int32[][]"
    every = tuple(Outcome)
    speed = of_view(lambda v: design_per_minute)

    def history(view: PackmlView) -> tuple[Any, ...]:
        return tuple(map(_alarm, view.faults))

    def reason(view: PackmlView) -> Any:
        return _alarms(view)[0] if _alarms(view) else NO_DATA

    return (
        Tag("Admin.ProdConsumedCount", count, "cycles of this run", _count("cables", every)),
        Tag("Admin.ProdProcessedCount", count, "the same", _count("cables", every)),
        Tag(
            "Admin.ProdDefectiveCount",
            count,
            "missed, rejected and failed ones",
            _count("cables", DEFECTIVE),
        ),
        Tag(
            "Admin.Alarm",
            alarms,
            "fault that nobody acknowledged",
            of_view(_alarms),
            reference="HasAlarm",
        ),
        Tag("Admin.AlarmExtent", "Int32", "1 = so many there may be", lambda v, t: 1, True),
        Tag(
            "Admin.AlarmHistory",
            alarms,
            "faults since the server began, newest first",
            of_view(history),
            reference="HasAlarmHistory",
        ),
        Tag("Admin.AlarmHistoryExtent", "Int32", "so many at most", lambda v, t: 32, True),
        Tag(
            "Admin.StopReason",
            alarm,
            "the first of Alarm",
            of_view(reason),
            reference="HasStopReason",
        ),
        Tag("Admin.StopReasonExtent", "Int32", "1 = so many there may be", lambda v, t: 1, True),
        Tag(
            "Admin.ModeCurrentTime",
            "Int32[]",
            "time in each mode, s, since the run began",
            _by_mode(_total),
        ),
        Tag("Admin.ModeCumulativeTime", "Int32[]", "the same", _by_mode(_total)),
        Tag(
            "Admin.StateCurrentTime",
            times,
            "time in this state, s; [mode][state number]",
            _by_state(_this_state),
        ),
        Tag(
            "Admin.StateCumulativeTime",
            times,
            "time in each state of this run, s",
            _by_state(_all_states),
        ),
        Tag("Admin.AccTimeSinceReset", "Int32", "time since the run began, s", _of_total),
        Tag("Admin.MachDesignSpeed", "Float", "as MachSpeed", speed, True),
    )


def _of_total(view: PackmlView, now_s: float) -> Any:
    return NO_DATA if view.status is None else _total(view, now_s)
