"""Variables of a unit that PackML has no name for: `Cell`, with plain values for simple clients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cell.plant.messages import FaultNotice
from cell.plant.opcua.machines import number_of
from cell.plant.opcua.tag import NO_DATA, Tag, Value, of, of_view, utc
from cell.plant.opcua.view import PackmlView
from cell.records.result import Outcome
from cell.run.machine import CellState

#: State of a cell that is not there.
NOT_CONNECTED = "not connected"


def _state(view: PackmlView) -> str:
    return view.status.state.value if view.connected and view.status else NOT_CONNECTED


def _number(view: PackmlView) -> int:
    """After ISA-TR88.00.02; 0 = not known."""
    return number_of(view.status.state) if view.connected and view.status else 0


def _fault(read: Callable[[FaultNotice], Any], none: Any = "") -> Value:
    return of(lambda s: none if s.fault is None else read(s.fault))


def _last(key: str, none: Any = None) -> Value:
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
    Tag("Cell.State", "String", f"state; `{NOT_CONNECTED}` without a cell", of_view(_state), True),
    Tag("Cell.StateCurrent", "Int32", "its number; 0 without a cell", of_view(_number), True),
    Tag("Cell.StateSince", "DateTime", "when it began", of(lambda s: utc(s.since_s))),
    Tag("Cell.Step", "String", "step of the cycle", of(lambda s: s.step or "")),
    Tag("Cell.Cycle", "UInt32", "number of the cycle; 0 = none yet", of(lambda s: s.cycle)),
    Tag("Cell.Part", "String", "id of the cable", of(lambda s: s.part or "")),
    Tag("Cell.Product", "String", "what is made", of(lambda s: s.product or "")),
    Tag("Cell.Products", "String[]", "what can be made", of(lambda s: list(s.products))),
    Tag(
        "Cell.WaitingFor",
        "String[]",
        "why nothing happens",
        of(lambda s: list(s.waiting_for)),
    ),
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
    Tag("Cell.LastResult.Cycle", "UInt32", "number of the cycle", _last("cycle")),
    Tag("Cell.LastResult.Outcome", "String", "how it ended", _last("outcome")),
    Tag("Cell.LastResult.Part", "String", "id of the cable", _last("part", "")),
    Tag("Cell.LastResult.Reason", "String", "why it was rejected or missed", _last("reason", "")),
    Tag("Cell.LastResult.Offset", "Double", "executed, m", _last("offset_m")),
    Tag("Cell.LastResult.Margin", "Double", "measured in the destination, m", _last("margin_m")),
    Tag("Cell.LastResult.PredictedMargin", "Double", "predicted, m", _last("predicted_margin_m")),
    Tag("Cell.LastResult.Probability", "Double", "predicted, of passing", _last("probability")),
    Tag(
        "Cell.LastResult.PredictionError",
        "Double",
        "largest between both paths, m",
        _last("prediction_error_m"),
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
