"""What a variable of a unit is, and how its value follows from the view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from cell.plant.messages import Status
from cell.plant.opcua.view import PackmlView


@dataclass(frozen=True)
class Missing:
    """There is no value; `quality` is a status code of OPC UA that says why."""

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
    """A value that follows from the status alone; None = there is none now."""

    def read(view: PackmlView, now_s: float) -> Any:
        found = None if view.status is None else value(view.status)
        return NO_DATA if found is None else found

    return read


def of_view(value: Callable[[PackmlView], Any]) -> Value:
    """A value that follows from the view alone; None = there is none now."""

    def read(view: PackmlView, now_s: float) -> Any:
        found = value(view)
        return NO_DATA if found is None else found

    return read


def utc(seconds: float | None) -> datetime | None:
    """A Unix time as a date."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)
