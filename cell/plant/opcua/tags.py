"""Variables of a unit: those of PackML, `Cell` with plain values, and how each is computed."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from cell.plant.messages import FaultNotice, Status
from cell.plant.opcua import packml
from cell.plant.opcua.machines import MACHINE_PATHS, MACHINES, active_states, number_of
from cell.plant.opcua.view import PackmlView, PastFault
from cell.records.result import Outcome
from cell.run.machine import CellState


@dataclass(frozen=True)
class Missing:
    """Value that is not available; `quality` is the OPC UA status code that says why."""

    quality: str


NO_DATA, NOT_ACTIVE = Missing("BadNoData"), Missing("BadStateNotActive")
NO_CELL = Missing("BadNoCommunication")

#: Value of a variable: plain data, a tuple for a structure, or `Missing`.
Value = Callable[[PackmlView, float], Any]


@dataclass(frozen=True)
class Tag:
    """A variable of a unit.

    path        browse names from the unit on, with dots
    type        of the data, as in the tables of `packml`
    meaning     a phrase
    value       from the view and the time now on the computer's own clock
    always      it is true without a cell, too; others keep their last value then, and say so
    reference, definition   how its parent has it, and its type definition
    """

    path: str
    type: str
    meaning: str
    value: Value
    always: bool = False
    reference: str = "HasComponent"
    definition: str = "BaseDataVariableType"


def of(value: Callable[[Status], Any]) -> Value:
    """Reader of a variable that depends on the status alone; None becomes `NO_DATA`."""

    def read(view: PackmlView, now_s: float) -> Any:
        found = None if view.status is None else value(view.status)
        return NO_DATA if found is None else found

    return read


def of_view(value: Callable[[PackmlView], Any]) -> Value:
    """Reader of a variable that depends on the view alone; None becomes `NO_DATA`."""

    def read(view: PackmlView, now_s: float) -> Any:
        found = value(view)
        return NO_DATA if found is None else found

    return read


def utc(seconds: float | None) -> datetime | None:
    """A Unix time as a UTC date and time."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


_PROPERTY = "HasProperty"
_NEVER = datetime(1601, 1, 1, tzinfo=UTC)

#: Cycles with these outcomes used a cable up without inserting it.
DEFECTIVE = (Outcome.MISSED, Outcome.REJECTED, Outcome.FAILED)
#: States that end by themselves.
ACTING = frozenset(s for s in CellState if s.value.endswith("ing")) | {CellState.EXECUTE}


def machine_tags(level: int) -> tuple[Tag, ...]:
    """Variables of a state machine, 0 = the outermost: its state and last transition."""
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
    return {view.status.state: max(0.0, view.last_known_s(now_s) - view.entered_s)}


def status_tags(design_per_minute: float | None) -> tuple[Tag, ...]:
    """Variables of PackML's `Status`.

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
    """Variables of PackML's `Admin`."""
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


#: State of a cell that is not there.
NOT_CONNECTED = "not connected"


def _state_name(view: PackmlView) -> str:
    return view.status.state.value if view.connected and view.status else NOT_CONNECTED


def _number(view: PackmlView) -> int:
    """After ISA-TR88.00.02; 0 = not known."""
    return number_of(view.status.state) if view.connected and view.status else 0


def _fault(read: Callable[[FaultNotice], Any], none: Any = "") -> Value:
    return of(lambda s: none if s.fault is None else read(s.fault))


def _result(key: str, none: Any = None) -> Value:
    """An entry of the newest result."""

    def read(view: PackmlView, now_s: float) -> Any:
        last = None if view.status is None else view.status.last
        found = None if last is None else last.get(key)
        return found if found is not None else NO_DATA if none is None else none

    return read


def _spent(state: CellState) -> Value:
    def read(view: PackmlView, now_s: float) -> Any:
        seconds = view.seconds_at(now_s).get(state.value, 0.0)
        return NO_DATA if view.status is None else round(seconds, 3)

    return read


def _counted(outcome: Outcome) -> Value:
    return of(lambda s: s.counts.get(outcome.value, 0))


_NOW = (
    Tag("Cell.Connected", "Boolean", "the cell is there", of_view(lambda v: v.connected), True),
    Tag(
        "Cell.State",
        "String",
        f"state; `{NOT_CONNECTED}` without a cell",
        of_view(_state_name),
        True,
    ),
    Tag("Cell.StateCurrent", "Int32", "its number; 0 without a cell", of_view(_number), True),
    Tag("Cell.StateSince", "DateTime", "when it began", of(lambda s: utc(s.since_s))),
    Tag("Cell.Step", "String", "step of the cycle", of(lambda s: s.step or "")),
    Tag("Cell.Cycle", "UInt32", "number of the cycle; 0 = none yet", of(lambda s: s.cycle)),
    Tag("Cell.Part", "String", "id of the cable", of(lambda s: s.part or "")),
    Tag("Cell.Product", "String", "what is made", of(lambda s: s.product or "")),
    Tag("Cell.Products", "String[]", "what can be made", of(lambda s: list(s.products))),
    Tag("Cell.WaitingFor", "String[]", "why nothing happens", of(lambda s: list(s.waiting_for))),
    Tag(
        "Cell.Possible",
        "String[]",
        "commands that this state accepts",
        of(lambda s: [event.value for event in s.possible]),
    ),
    Tag(
        "Cell.Refusal",
        "String",
        "why the last command was refused",
        of_view(lambda v: v.refusal),
        True,
    ),
    Tag(
        "Cell.Acknowledged",
        "String",
        "who said what about the last fault",
        of_view(lambda v: v.acknowledged),
        True,
    ),
    Tag("Cell.Line", "String", "the line, as in the ledger", of(lambda s: s.line)),
    Tag("Cell.Run", "String", "identifies the cell's process", of(lambda s: s.run)),
    Tag("Cell.Model", "String", "hash of the model", of(lambda s: s.model or "")),
    Tag("Cell.Calibration", "String", "hash of the calibration", of(lambda s: s.calibration or "")),
    Tag("Cell.Software", "String", "version of the program", of(lambda s: s.software)),
)

_FAULT = (
    Tag(
        "Cell.Fault.Active", "Boolean", "nobody has acknowledged it", _fault(lambda f: True, False)
    ),
    Tag("Cell.Fault.Cycle", "UInt32", "in which cycle", _fault(lambda f: f.cycle, 0)),
    Tag("Cell.Fault.Step", "String", "in which step", _fault(lambda f: f.step)),
    Tag("Cell.Fault.Device", "String", "of which device", _fault(lambda f: f.device or "")),
    Tag("Cell.Fault.Code", "String", "its kind", _fault(lambda f: f.code)),
    Tag("Cell.Fault.Cause", "String", "why", _fault(lambda f: f.cause)),
    Tag("Cell.Fault.Remedy", "String", "what a person can do", _fault(lambda f: f.remedy)),
    Tag("Cell.Fault.Cable", "String", "where the cable is", _fault(lambda f: f.cable)),
    Tag("Cell.Fault.Time", "DateTime", "when", _fault(lambda f: utc(f.time_s), None)),
)

_RESULT = (
    Tag("Cell.LastResult.Cycle", "UInt32", "number of the cycle", _result("cycle")),
    Tag("Cell.LastResult.Outcome", "String", "how it ended", _result("outcome")),
    Tag("Cell.LastResult.Part", "String", "id of the cable", _result("part", "")),
    Tag("Cell.LastResult.Reason", "String", "why it was rejected or missed", _result("reason", "")),
    Tag("Cell.LastResult.Offset", "Double", "executed, m", _result("offset_m")),
    Tag("Cell.LastResult.Margin", "Double", "measured in the destination, m", _result("margin_m")),
    Tag("Cell.LastResult.PredictedMargin", "Double", "predicted, m", _result("predicted_margin_m")),
    Tag("Cell.LastResult.Probability", "Double", "predicted, of passing", _result("probability")),
    Tag(
        "Cell.LastResult.PredictionError",
        "Double",
        "largest between both paths, m",
        _result("prediction_error_m"),
    ),
)

#: All of them.
CELL_TAGS = (
    *_NOW,
    *_FAULT,
    *_RESULT,
    *(
        Tag(f"Cell.Counts.{o.value.title()}", "UInt32", f"cycles that ended {o.value}", _counted(o))
        for o in Outcome
    ),
    *(
        Tag(f"Cell.Seconds.{s.value.title()}", "Double", f"time spent {s.value}, s", _spent(s))
        for s in CellState
    ),
)
