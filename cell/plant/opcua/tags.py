"""Variables of a unit: those of PackML, `Cell` with plain values, and how each is computed."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from cell.plant.messages import Status
from cell.plant.opcua import packml
from cell.plant.opcua.packml import MACHINE_PATHS, MACHINES, active_states, number_of
from cell.plant.opcua.view import FAULTS, PackmlView, PastFault
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
    always      valid without a cell, too; others keep their last value then, marked as uncertain
    reference, definition   reference type from its parent, and its type definition
    """

    path: str
    type: str
    meaning: str
    value: Value
    always: bool = False
    reference: str = "HasComponent"
    definition: str = "BaseDataVariableType"


_DECLARED = {
    f"{below}{declared.name}": declared
    for below, group in (("", packml.UNIT), ("Status.", packml.STATUS), ("Admin.", packml.ADMIN))
    for declared in group
}


def packml_tag(path: str, meaning: str, value: Value, always: bool) -> Tag:
    """A variable declared by PackML, with the declared type and reference."""
    declared = _DECLARED[path]
    definition = "BaseDataVariableType" if declared.range_id is None else "AnalogItemType"
    return Tag(path, declared.type, meaning, value, always, declared.reference, definition)


def of(value: Callable[[Status], Any]) -> Value:
    """Reader of a variable that depends on the status alone; None becomes `NO_DATA`."""

    def read(view: PackmlView, now_s: float) -> Any:
        result = None if view.status is None else value(view.status)
        return NO_DATA if result is None else result

    return read


def of_view(value: Callable[[PackmlView], Any]) -> Value:
    """Reader of a variable that depends on the view alone; None becomes `NO_DATA`."""

    def read(view: PackmlView, now_s: float) -> Any:
        result = value(view)
        return NO_DATA if result is None else result

    return read


def utc(seconds: float | None) -> datetime | None:
    """A Unix time as a UTC date and time."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


_PROPERTY = "HasProperty"
_NEVER = datetime(1601, 1, 1, tzinfo=UTC)

#: Outcomes of cycles that used up a cable without inserting it.
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
        result = view.transitions.get(level, (None, None))[item]
        return NO_DATA if result is None else result

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
    end = datetime.fromtimestamp(past.acknowledged_s, UTC) if past.acknowledged_s else _NEVER
    return (number, fault.cycle, text, category, at, end, open_)


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

    design_per_minute  cables that the cell makes at best; None = not set
    """
    design = "ideal cables/min, by `ledger.ideal_cycle_s`"
    blocked = of(lambda s: "downstream" in s.waiting_for)
    starved = of(lambda s: not {"part", "upstream"}.isdisjoint(s.waiting_for))
    modes, mode = "1 production, 2 maintenance, 3 manual", of(lambda s: packml.MODE_NUMBERS[s.mode])
    rows: tuple[tuple[str, str, Value, bool], ...] = (
        ("UnitSupportedModes", "enumeration of the modes", lambda v, t: packml.MODE_ENUM, True),
        ("UnitModeCurrent", modes, mode, False),
        (
            "StateChangeInProcess",
            "the state ends by itself",
            of(lambda s: s.state in ACTING),
            False,
        ),
        ("MachSpeed", design, of_view(lambda v: design_per_minute), True),
        ("CurMachSpeed", "cables/min, as the last cycle took", of_view(_speed), False),
        ("EquipmentBlocked", "waits for downstream", blocked, False),
        ("EquipmentStarved", "waits for a part or upstream", starved, False),
        ("Product", "number of the product, from 1", of(_product), False),
    )
    return tuple(packml_tag(f"Status.{row[0]}", *row[1:]) for row in rows)


def admin_tags(design_per_minute: float | None) -> tuple[Tag, ...]:
    """Variables of PackML's `Admin`."""
    every, defective = _count("cables", tuple(Outcome)), _count("cables", DEFECTIVE)

    def history(view: PackmlView) -> tuple[Any, ...]:
        return tuple(map(_alarm, view.faults))

    def reason(view: PackmlView) -> Any:
        return _alarms(view)[0] if _alarms(view) else NO_DATA

    in_state, in_states = _by_state(_this_state), _by_state(_all_states)
    rows: tuple[tuple[str, str, Value, bool], ...] = (
        ("ProdConsumedCount", "cycles of this run", every, False),
        ("ProdProcessedCount", "the same", every, False),
        ("ProdDefectiveCount", "missed, rejected and failed ones", defective, False),
        ("Alarm", "fault that nobody acknowledged", of_view(_alarms), False),
        ("AlarmExtent", "1 = so many there may be", lambda v, t: 1, True),
        ("AlarmHistory", "faults since the server began, newest first", of_view(history), False),
        ("AlarmHistoryExtent", "so many at most", lambda v, t: FAULTS, True),
        ("StopReason", "the first of Alarm", of_view(reason), False),
        ("StopReasonExtent", "1 = so many there may be", lambda v, t: 1, True),
        ("ModeCurrentTime", "time in each mode, s, since the run began", _by_mode(_total), False),
        ("ModeCumulativeTime", "the same", _by_mode(_total), False),
        ("StateCurrentTime", "time in this state, s; [mode][state number]", in_state, False),
        ("StateCumulativeTime", "time in each state of this run, s", in_states, False),
        ("AccTimeSinceReset", "time since the run began, s", _of_total, False),
        ("MachDesignSpeed", "as MachSpeed", of_view(lambda v: design_per_minute), True),
    )
    return tuple(packml_tag(f"Admin.{row[0]}", *row[1:]) for row in rows)


def _of_total(view: PackmlView, now_s: float) -> Any:
    return NO_DATA if view.status is None else _total(view, now_s)


#: State of a cell that is not there.
NOT_CONNECTED = "not connected"


def _state_name(view: PackmlView) -> str:
    return view.status.state.value if view.connected and view.status else NOT_CONNECTED


def _number(view: PackmlView) -> int:
    """After ISA-TR88.00.02; 0 = not known."""
    return number_of(view.status.state) if view.connected and view.status else 0


def _fault(entry: str, none: Any) -> Value:
    """An entry of the fault that nobody has acknowledged; `none` without one."""

    def read(status: Status) -> Any:
        result = None if status.fault is None else getattr(status.fault, entry)
        return none if result is None else utc(result) if entry == "time_s" else result

    return of(read)


def _result(entry: str, none: Any) -> Value:
    """An entry of the newest result; `none` where it is missing or null."""

    def read(status: Status) -> Any:
        result = (status.last or {}).get(entry)
        return none if result is None else result

    return of(read)


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

#: Of a fault: name, type, meaning, entry of the notice, and value without a fault.
_FAULT: tuple[tuple[str, str, str, str, Any], ...] = (
    ("Cycle", "UInt32", "in which cycle", "cycle", 0),
    ("Step", "String", "in which step", "step", ""),
    ("Device", "String", "of which device", "device", ""),
    ("Code", "String", "its kind", "code", ""),
    ("Cause", "String", "why", "cause", ""),
    ("Remedy", "String", "what a person can do", "remedy", ""),
    ("Cable", "String", "where the cable is", "cable", ""),
    ("Time", "DateTime", "when", "time_s", None),
)
#: Of the newest result: name, type, meaning, its entry, and value where that is null.
_RESULT: tuple[tuple[str, str, str, str, Any], ...] = (
    ("Cycle", "UInt32", "number of the cycle", "cycle", None),
    ("Outcome", "String", "how it ended", "outcome", None),
    ("Part", "String", "id of the cable", "part", ""),
    ("Reason", "String", "why it was rejected or missed", "reason", ""),
    ("Offset", "Double", "executed, m", "offset_m", None),
    ("Miss", "Double", "tip above the middle, m", "measured_miss_m", None),
    ("Margin", "Double", "measured in the destination, m", "margin_m", None),
    ("PredictedMargin", "Double", "predicted, m", "predicted_margin_m", None),
    ("Probability", "Double", "predicted, of passing", "probability", None),
    ("PredictionError", "Double", "largest between both paths, m", "prediction_error_m", None),
)
_FAULTED = of(lambda s: s.fault is not None)

#: All of them.
CELL_TAGS = (
    *_NOW,
    Tag("Cell.Fault.Active", "Boolean", "nobody has acknowledged it", _FAULTED),
    *(Tag(f"Cell.Fault.{n}", kind, what, _fault(e, none)) for n, kind, what, e, none in _FAULT),
    *(
        Tag(f"Cell.LastResult.{n}", kind, what, _result(e, none))
        for n, kind, what, e, none in _RESULT
    ),
    *(
        Tag(f"Cell.Counts.{o.value.title()}", "UInt32", f"cycles that ended {o.value}", _counted(o))
        for o in Outcome
    ),
    *(
        Tag(f"Cell.Seconds.{s.value.title()}", "Double", f"time spent {s.value}, s", _spent(s))
        for s in CellState
    ),
)
