"""The trial of the handshake sees what a cell may not do: each kind of it in a made-up history."""

from __future__ import annotations

from typing import Any

import pytest

from cell.plant.messages import MessageKind, Notice
from tools.faults.handshake_trial import compared
from tools.faults.scripted_plc import INPUTS

READY = {**dict.fromkeys(INPUTS, True), "acknowledge": False, "stop": False}


def state(time_s: float, name: str) -> Notice:
    return Notice("r", 1, time_s, MessageKind.STATE, {"state": name})


def result(time_s: float, outcome: str) -> Notice:
    return Notice("r", 1, time_s, MessageKind.RESULT, {"outcome": outcome})


def fault(time_s: float) -> Notice:
    return Notice("r", 1, time_s, MessageKind.FAULT, {})


def said(time_s: float, **signals: bool) -> dict[str, Any]:
    return {"time_s": time_s, "said": {**READY, **signals}}


CYCLE = [state(2.0, "starting"), state(3.0, "suspended"), result(4.0, "missed")]
HEARD = [said(1.0), {"time_s": 5.0, "habit": "plain", "told": "rejected"}]


def test_a_cycle_as_it_should_be() -> None:
    found = compared(HEARD, [*CYCLE, fault(6.0)])
    assert (found.cycles, found.starts, found.suspensions) == (1, 1, 1)
    assert found.outcomes == {"missed": 1} and found.wrong == ()


@pytest.mark.parametrize(
    ("heard", "happened", "wrong"),
    [
        ([said(1.0, part_present=False), HEARD[1]], CYCLE, "a start without part_present"),
        ([said(1.0, start=False), HEARD[1]], CYCLE, "a start without start"),
        ([said(1.0, stop=True), HEARD[1]], CYCLE, "a start while stop is on"),
        ([HEARD[1]], CYCLE, "a start without part_present"),
        (HEARD, [fault(1.0), *CYCLE], "starting after a fault without an acknowledgement"),
        (HEARD, [*CYCLE, fault(5.0), state(6.0, "resetting")], "resetting after a fault without"),
        (HEARD, [*CYCLE, state(6.0, "starting")], "1 cycles were wanted, and 2 made"),
        (HEARD, CYCLE[:2], "1 outcomes were told, and there were 0"),
        (HEARD, [CYCLE[0], result(4.0, "inserted")], "was inserted, and the PLC was told rejected"),
    ],
)
def test_what_may_not_happen_is_said(
    heard: list[dict[str, Any]], happened: list[Notice], wrong: str
) -> None:
    assert any(wrong in sentence for sentence in compared(heard, happened).wrong)


def test_an_acknowledgement_lets_the_cell_go_on() -> None:
    acknowledged = Notice("r", 1, 1.5, MessageKind.ACKNOWLEDGED, {"by": "plc", "note": ""})
    assert compared(HEARD, [fault(1.2), acknowledged, state(1.6, "resetting"), *CYCLE]).wrong == ()
