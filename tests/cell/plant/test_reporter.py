"""What the link is told of a cell."""

from __future__ import annotations

import re
import shlex
import socket
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cell.plant.messages import MessageKind, Request, possible_in
from cell.plant.reporter import Reporter, latch
from cell.plant.systemd import Notifier, unit_of
from cell.run.commands import Commands
from cell.run.machine import CellState, Machine, MachineEvent
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


def test_what_is_possible_is_what_the_machine_knows() -> None:
    assert possible_in(CellState.ABORTED) == (MachineEvent.CLEAR,)
    assert possible_in(CellState.STARTING) == (MachineEvent.STOP, MachineEvent.ABORT)
    assert possible_in(CellState.STARTING, {MachineEvent.ABORT}) == (MachineEvent.ABORT,)


def test_what_a_cell_waits_for_is_told_once() -> None:
    told: list[object] = []
    reporter = Reporter(lambda kind, data: told.append(data.get("waiting_for")))
    for state in ("execute", "suspending", "suspended", "clearing", "stopped"):
        reporter.suspended_for = "downstream"
        reporter.state(CellState(state))
    assert [waiting for waiting in told if waiting is not None] == [["downstream"], [], ["reset"]]


def test_waits_are_summed_by_what_for_until_they_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of a cycle that never began: the ledger gets them with the next one."""
    now_s = [0.0]
    monkeypatch.setattr("cell.plant.reporter.time.monotonic", lambda: now_s[0])
    reporter = Reporter(lambda kind, data: None)
    for at_s, state in ((1.0, "idle"), (4.0, "starting"), (9.0, "idle"), (11.0, "stopped")):
        now_s[0] = at_s
        reporter.state(CellState(state))
    now_s[0] = 12.0
    assert reporter.take_waited() == {"start": 5.0, "acknowledgement": 1.0}
    now_s[0] = 14.0
    assert reporter.take_waited() == {"acknowledgement": 2.0}


def test_each_pause_that_has_not_begun_can_be_taken_back() -> None:
    """The line suspends the cell, a person asks for a hold too, and thinks better of it."""
    machine, commands = Machine(lambda: 0.0), Commands()
    for event in (
        MachineEvent.RESET,
        MachineEvent.DONE,
        MachineEvent.START,
        MachineEvent.DONE,
        MachineEvent.SUSPEND,
        MachineEvent.DONE,
    ):
        machine.send(event)
    commands.give(MachineEvent.SUSPEND)
    cell = SimpleNamespace(machine=machine, commands=commands, command=commands.give)
    assert machine.state is CellState.SUSPENDED
    for event, accepted in (
        (MachineEvent.UNHOLD, False),
        (MachineEvent.HOLD, True),
        (MachineEvent.UNHOLD, True),
    ):
        assert latch(cast(Any, cell), Request(event, "Ada")).accepted is accepted
    assert commands.pause is MachineEvent.SUSPEND
    assert latch(cast(Any, cell), Request(MachineEvent.UNSUSPEND, "plc")).accepted
    assert commands.pause is None


@pytest.mark.parametrize(
    "name", ["plain", "a b", "50%", "%h", "$HOME", "${x}", 'q"q', "b\\s", "@x"]
)
def test_a_unit_means_the_paths_that_it_was_made_of(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a path with a blank systemd saw two words, and of `%h` a home."""
    of_program = "plain" if set(name) & set('"\\') else name
    monkeypatch.setattr("sys.executable", f"/opt/{of_program}/python")
    config, runs, folder = (Path("/srv", name, last) for last in ("cell.yaml", "runs", "work"))
    unit = dict(
        line.split("=", 1)
        for line in unit_of(config, runs, folder, "ada").splitlines()
        if "=" in line
    )
    program, *words = shlex.split(unit["ExecStart"])  # quoted as for a shell, without its rest
    assert program.replace("%%", "%") == f"@/opt/{of_program}/python"
    meant = [word.replace("%%", "%").replace("$$", "$") for word in words]
    assert meant == [
        *(f"/opt/{of_program}/python", "-m", "cell", "run", "--config", str(config)),
        *("--runs", str(runs), "--cycles", "forever", "--json"),
    ]
    for word in (program, *words, unit["WorkingDirectory"], unit["Description"]):
        assert not re.search("%(?!%)", word.replace("%%", ""))
    assert not any("$" in word.replace("$$", "") for word in words)
    assert unit["WorkingDirectory"].replace("%%", "%") == str(folder)
    with pytest.raises(ValueError, match="line break"):
        unit_of(Path("/a\nb"), runs, folder, "ada")
    for user in ("no body", "", "ada\nUser=root", "%h"):
        with pytest.raises(ValueError, match="is no name of a user"):
            unit_of(config, runs, folder, user)
    monkeypatch.setattr("sys.executable", '/opt/q"q/python')
    with pytest.raises(ValueError, match="another folder"):
        unit_of(config, runs, folder, "ada")


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
