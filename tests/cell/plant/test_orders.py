"""Status after notices, what a state accepts, and what systemd is told."""

from __future__ import annotations

import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from cell.plant.folded import possible_in
from cell.plant.messages import Request
from cell.plant.orders import latch
from cell.plant.reporter import Reporter
from cell.plant.systemd import Notifier
from cell.run.commands import Commands
from cell.run.machine import CellState, Event, Machine


def test_what_is_possible_is_what_the_machine_knows() -> None:
    assert possible_in(CellState.ABORTED) == (Event.CLEAR,)
    assert possible_in(CellState.STARTING) == (Event.STOP, Event.ABORT)
    assert possible_in(CellState.STARTING, {Event.ABORT}) == (Event.ABORT,)


def test_what_a_cell_waits_for_is_told_once() -> None:
    told: list[object] = []
    reporter = Reporter(lambda kind, data: told.append(data.get("waiting_for")))
    for state in ("execute", "suspending", "suspended", "clearing", "stopped"):
        reporter.suspended_for = "downstream"
        reporter.state(CellState(state))
    assert [waiting for waiting in told if waiting is not None] == [["downstream"], [], ["reset"]]


def test_each_pause_that_has_not_begun_can_be_taken_back() -> None:
    """The line suspends the cell, a person asks for a hold too, and thinks better of it."""
    machine, commands = Machine(lambda: 0.0), Commands()
    for event in (Event.RESET, Event.DONE, Event.START, Event.DONE, Event.SUSPEND, Event.DONE):
        machine.send(event)
    commands.give(Event.SUSPEND)
    cell = SimpleNamespace(machine=machine, commands=commands, command=commands.give)
    assert machine.state is CellState.SUSPENDED
    for event, accepted in ((Event.UNHOLD, False), (Event.HOLD, True), (Event.UNHOLD, True)):
        assert latch(cast(Any, cell), Request(event, "Ada")).accepted is accepted
    assert commands.pause is Event.SUSPEND
    assert latch(cast(Any, cell), Request(Event.UNSUSPEND, "plc")).accepted
    assert commands.pause is None


def test_without_systemd_nothing_is_told() -> None:
    notifier = Notifier({})
    notifier.ready()
    assert notifier.watchdog_s is None


def test_a_systemd_that_does_not_read_is_not_waited_for(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.bind(str(tmp_path / "notify"))
        notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "3000000"})
        assert notifier.watchdog_s == 3.0
        for _ in range(2000):
            notifier.status("a\nb")
        assert told.recv(100) == b"STATUS=a b"
    assert Notifier({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"}).watchdog_s is None
