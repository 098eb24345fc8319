"""What the link is told of a cell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cell.plant.messages import MessageKind
from cell.plant.reporter import Reporter
from cell.run.machine import CellState
from cell.run.plans import INSERTING


def test_every_step_is_told_and_a_pause_is_none() -> None:
    """`execute` is a state, too, and was not told."""
    told: list[str] = []

    def publish(kind: MessageKind, data: Mapping[str, Any]) -> None:
        assert kind is MessageKind.STEP
        told.append(data["step"])

    reporter = Reporter(publish)
    for step in (*INSERTING.names, CellState.HELD.value, CellState.SUSPENDED.value):
        reporter.step(1, step)
    assert tuple(told) == INSERTING.names
