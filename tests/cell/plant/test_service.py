"""What a service answers while it waits for a person."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cell.plant.messages import CommandReply, MessageKind, Request
from cell.plant.reporter import Reporter
from cell.plant.service import Service
from cell.records.folder import Record
from cell.run.cycle import Cell
from cell.run.machine import CellState, MachineEvent
from drivers.clock import RealClock

Told = list[tuple[MessageKind, Mapping[str, Any]]]


@pytest.fixture
def told() -> Told:
    return []


def service_of(runs: Path, told: Told) -> Service:
    """A service that does not run, of a cell whose arm only stops."""
    arm = SimpleNamespace(stop=lambda reason: None)
    devices = SimpleNamespace(arm=arm, clock=RealClock())
    made = SimpleNamespace(name=None, task=None)
    cell = Cell(cast(Any, devices), cast(Any, made), runs)
    return Service(cell, Reporter(lambda kind, data: told.append((kind, data))), runs)


def ask(service: Service, command: MachineEvent) -> CommandReply:
    return service.answer(Request(command, "Ada", note="guard opened"))


def test_an_abort_in_stopped_is_not_taken_back_by_a_reset(tmp_path: Path, told: Told) -> None:
    """The reset acknowledged what came before, and the gripper moved."""
    runs = tmp_path / "runs"
    Record(runs, 1, datetime.now(UTC))  # a cycle that was killed
    service = service_of(runs, told)
    aborted = ask(service, MachineEvent.ABORT)
    assert (aborted.accepted, aborted.state) == (True, CellState.ABORTED)
    refused = ask(service, MachineEvent.RESET)
    assert not refused.accepted and refused.reason.endswith("possible now: acknowledge, clear")
    assert ask(service, MachineEvent.CLEAR).state is CellState.STOPPED
    assert ask(service, MachineEvent.RESET).state is CellState.RESETTING


def test_a_refusal_names_acknowledge_while_there_is_something_to_acknowledge(
    tmp_path: Path, told: Told
) -> None:
    runs = tmp_path / "runs"
    Record(runs, 1, datetime.now(UTC))  # a cycle that was killed
    service = service_of(runs, told)
    for command in (MachineEvent.START, MachineEvent.HOLD):
        assert ask(service, command).reason.endswith("now: acknowledge, reset, abort")
    assert service.answer(Request(None, "Ada", note="looked")).accepted
    assert ask(service, MachineEvent.START).reason.endswith("possible now: reset, abort")


def test_an_abort_in_stopped_outlives_the_service(tmp_path: Path, told: Told) -> None:
    runs = tmp_path / "runs"
    Record(runs, 1, datetime.now(UTC))
    service = service_of(runs, told)
    for command in (
        MachineEvent.ABORT,
        MachineEvent.CLEAR,
        MachineEvent.ABORT,
    ):  # the last when all is acknowledged
        assert ask(service, command).accepted
    faults = [(data["code"], data["cause"]) for kind, data in told if kind is MessageKind.FAULT]
    assert [code for code, _ in faults] == ["unfinished", "abort"]
    assert faults[-1][1] == "guard opened by Ada"
    told.clear()
    service_of(runs, told)
    assert [data["state"] for kind, data in told if kind is MessageKind.STATE] == ["stopped"]
    causes = [data["cause"] for kind, data in told if kind is MessageKind.FAULT]
    assert causes == ["abort: guard opened by Ada"]


@pytest.mark.parametrize("command", [MachineEvent.START, MachineEvent.RESET])
def test_nothing_moves_if_the_process_was_halted_after_it_had_accepted(
    tmp_path: Path, told: Told, monkeypatch: pytest.MonkeyPatch, command: MachineEvent
) -> None:
    """A start was accepted, the process halted, and the arm moved as soon as it went on."""
    service = service_of(tmp_path / "runs", told)
    cell = service._cell
    given: list[MachineEvent] = []

    def moves(*_: object) -> None:
        assert given == [MachineEvent.STOP]
        service.end()

    monkeypatch.setattr(cell, "prepare", lambda *_: None)
    service._prepare()
    if command is MachineEvent.START:
        cell.machine.send(MachineEvent.DONE)
    else:
        cell.machine.send(MachineEvent.STOP)
        cell.machine.send(MachineEvent.DONE)
    monkeypatch.setattr(cell, "prepare", moves)
    monkeypatch.setattr(cell, "run_prepared", moves)
    monkeypatch.setattr(cell, "command", lambda event, reason: given.append(event))
    accepted = service.answer(Request(command, "Ada", asked_s=monotonic() - 1.5))
    assert accepted.accepted
    service._run_next() if command is MachineEvent.START else service._prepare()
    assert given == [MachineEvent.STOP]


def test_acknowledging_moves_nothing_and_the_reset_that_follows_does(
    tmp_path: Path, told: Told
) -> None:
    """One press acknowledged, opened the jaws and brought the gripper home."""
    runs = tmp_path / "runs"
    Record(runs, 1, datetime.now(UTC))  # a cycle that was killed
    service = service_of(runs, told)
    word = Request(None, "Ada", "cable taken out")
    answer = service.answer(word)
    assert (answer.accepted, answer.state) == (True, CellState.STOPPED)
    said = [
        (kind, data)
        for kind, data in told
        if kind in (MessageKind.ACKNOWLEDGED, MessageKind.WAITING)
    ]
    assert said[-2:] == [
        (MessageKind.ACKNOWLEDGED, {"by": "Ada", "note": "cable taken out"}),
        (MessageKind.WAITING, {"waiting_for": ["reset"]}),
    ]
    assert not service._never_ran  # else it would make itself ready now
    assert "there is nothing to acknowledge" in service.answer(word).reason
    assert ask(service, MachineEvent.ABORT).accepted
    assert service.answer(word).state is CellState.STOPPED
