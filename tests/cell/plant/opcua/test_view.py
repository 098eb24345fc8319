"""What the server counts by itself: times in the states, and what a cycle takes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from cell.plant.messages import MessageKind, Notice, Status
from cell.plant.opcua.tags import admin_tags
from cell.plant.opcua.view import PackmlView
from cell.run.machine import CellState

NOON, HOUR_S = 1.8e9, 3600.0


@pytest.mark.parametrize("set_by_s", [0.0, HOUR_S, -HOUR_S])
def test_a_clock_that_is_set_changes_no_duration(set_by_s: float) -> None:
    """A computer without a battery finds the time in the net when the cell runs already."""
    sequence = 1

    def notice(ran_s: float, kind: MessageKind, data: Mapping[str, Any]) -> Notice:
        nonlocal sequence
        sequence += 1
        return Notice("r", sequence, NOON + set_by_s + ran_s, kind, data, ran_s=ran_s)

    def state(ran_s: float, state: CellState) -> Notice:
        return notice(ran_s, MessageKind.STATE, {"state": state.value, "step": None, "since": NOON})

    idle = Status("r", 1, CellState.IDLE, NOON + 95.0, state_seconds={"idle": 5.0})
    view = PackmlView().after_status(idle, 100.0, NOON + 100.0)
    assert current_s(view, 101.0) == 6
    for said in (
        state(110.0, CellState.EXECUTE),
        notice(110.0, MessageKind.CYCLE, {"cycle": 1, "part": None, "product": None}),
        state(117.0, CellState.COMPLETE),
        notice(118.0, MessageKind.RESULT, {"cycle": 1, "outcome": "inserted"}),
    ):
        view = view.after_notice(said)
    assert view.seconds_at(120.0) == {"idle": 15.0, "execute": 7.0, "complete": 3.0}
    assert view.cycle_s == 8.0
    assert current_s(view, 120.0) == 3
    assert view.lost(119.0).seconds_at(500.0)["complete"] == 2.0


def current_s(view: PackmlView, now_s: float) -> int:
    """Time in the present state, as clients read it."""
    [tag] = [t for t in admin_tags(None) if t.path == "Admin.StateCurrentTime"]
    return sum(map(sum, tag.value(view, now_s)))
