"""Faults as a person gives them: read, told when they come, and listed in the docs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cell.wiring.faults import KINDS, DeviceFaults, RequestedFault, read_fault
from drivers.emulators.camera import StreamFaults
from drivers.emulators.launch import EmulatorError
from drivers.emulators.robotiq import RobotiqFaults

DOCS = Path(__file__).parents[3] / "docs" / "howto" / "commission.md"


class Asked:
    """A device that notes what it is asked for."""

    def __init__(self, dead: bool = False) -> None:
        self.dead, self.ops, self.faults = dead, [], None

    def request(self, op: str, **arguments: Any) -> None:
        if self.dead:
            raise EmulatorError("is gone")
        self.ops.append((op, arguments))

    def plug(self) -> None:
        self.ops.append(("plug", {}))

    def unplug(self) -> None:
        self.ops.append(("unplug", {}))

    def lay_out(self, cable: bool) -> None:
        self.ops.append(("lay_out", {"cable": cable}))


@pytest.fixture
def cell() -> SimpleNamespace:
    return SimpleNamespace(controller=Asked(), camera=Asked(), gripper=Asked(), on_grip=None)


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ("camera.lost@2s", RequestedFault("camera.lost", 2.0)),
        (" camera.lost@.5 ", RequestedFault("camera.lost", 0.5)),
        ("arm.protective_stop", RequestedFault("arm.protective_stop")),
    ],
)
def test_a_fault_is_read_with_its_time(given: str, fault: RequestedFault) -> None:
    assert read_fault(given) == fault


@pytest.mark.parametrize("given", ["", "@2s", "camera.lost@-1s", "camera.lost@nan", "camera.lost@"])
def test_what_is_no_fault_is_refused_with_an_example(given: str) -> None:
    with pytest.raises(ValueError, match=r"like camera\.lost@2s"):
        read_fault(given)


def test_every_fault_can_be_caused_and_stands_in_the_docs(cell: SimpleNamespace) -> None:
    said: list[str] = []
    faults = DeviceFaults(cell, said.append)
    page = DOCS.read_text(encoding="utf-8")
    for name, (what, _) in KINDS.items():
        faults.give(RequestedFault(name))
        assert said[-1] == f"{name}: {what}"
        assert f"| `{name}` | {what} |" in page
    faults.repair()
    assert cell.camera.faults == StreamFaults() and cell.gripper.faults == RobotiqFaults()
    assert cell.controller.ops[-1] == ("clear", {})
    assert cell.gripper.ops[-2:] == [("plug", {}), ("lay_out", {"cable": True})]


def test_a_fault_with_a_time_comes_with_the_next_cable_only(cell: SimpleNamespace) -> None:
    said: list[str] = []
    faults = DeviceFaults(cell, said.append)
    faults.give(read_fault("gripper.lost@0s"))
    assert cell.gripper.ops == []
    for _ in range(2):
        cell.on_grip()
        for timer in faults._timers:
            timer.join(5.0)
    assert cell.gripper.ops == [("unplug", {})]
    faults.give(read_fault("gripper.lost@0s"))
    faults.repair()
    cell.gripper.ops.clear()
    cell.on_grip()
    assert cell.gripper.ops == [], "what was repaired comes no more"


def test_a_dead_emulator_is_said_and_ends_nothing(cell: SimpleNamespace) -> None:
    said: list[str] = []
    cell.controller.dead = True
    faults = DeviceFaults(cell, said.append)
    faults.give(RequestedFault("arm.lost"))
    faults.repair()
    assert said == ["arm.lost: cannot be given: is gone", "repair: is gone"]
