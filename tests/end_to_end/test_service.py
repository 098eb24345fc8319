"""The cell as a service, in its own process: starts, a planned end, a kill and what follows."""

from __future__ import annotations

import json
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

import pytest

from cell.plant.client import Client
from cell.plant.messages import MessageKind, Notice, Request, Status
from cell.records.folder import Record, read_record
from cell.records.ledger.ledger import Ledger, LedgerQuery
from cell.run.machine import CellState, MachineEvent

from .conftest import run
from .forked import Forked, Forking

Start = Callable[..., Forked]


@pytest.fixture
def start(forking: Forking, quick_config: Path, tmp_path: Path) -> Iterator[Start]:
    begun: list[Forked] = []

    def start(cycles: str = "forever", config: Path = quick_config, **environment: str) -> Forked:
        words = ("--cycles", cycles, "--json", "--runs", tmp_path / "runs")
        begun.append(forking.start("run", "-c", config, *words, environment=environment))
        return begun[-1]

    yield start
    for process in begun:
        process.kill()
        process.wait(30)


#: What a cell does not reach after so long it never does, s.
LONGEST_S = 120.0


def until(client: Client, reached: Callable[[Notice | Status], bool]) -> Notice | Status:
    """What happens first that is as it should be; if it is late the client is closed."""
    late = threading.Timer(LONGEST_S, client.close)
    late.daemon = True
    late.start()
    last: list[Notice | Status] = []
    try:
        for message in client.follow():
            if reached(message):
                return message
            last = [message] if isinstance(message, Status) else [*last[:1], message]
    finally:
        late.cancel()
    raise AssertionError(f"it did not happen within {LONGEST_S} s; last came {last}")


def waits_for(what: str) -> Callable[[Notice | Status], bool]:
    def reached(message: Notice | Status) -> bool:
        if isinstance(message, Status):
            return message.waiting_for == (what,)
        return message.kind is MessageKind.WAITING and message.data["waiting_for"] == [what]

    return reached


def in_step(step: str) -> Callable[[Notice | Status], bool]:
    def reached(message: Notice | Status) -> bool:
        if isinstance(message, Status):
            return message.step == step
        return message.kind is MessageKind.STEP and message.data["step"] == step

    return reached


def test_two_starts_then_an_end_within_the_third_cycle(
    start: Start, quick_config: Path, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    told = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    told.bind(str(tmp_path / "notify"))
    said: list[bytes] = []

    def hear() -> None:
        while not said or said[-1] != b"STOPPING=1":
            said.append(told.recv(1000))

    told.settimeout(60.0)
    hearing = threading.Thread(target=hear, daemon=True)
    hearing.start()
    process = start(NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC="600000")
    client = Client(runs).connect(wait_s=60.0)
    for part in ("A-1", "A-2"):
        until(client, waits_for("start"))
        words = ("--part", part, "--by", "Ada", "-c", quick_config, "--runs", runs)
        assert run("send", "start", *words).returncode == 0
        again = run("send", "start", "--runs", runs)
        assert again.returncode == 1
        assert "'start' is refused while" in again.stderr
    until(client, waits_for("start"))
    own = ("-c", quick_config, "--runs", runs)
    assert run("status", *own).returncode == 0
    other = tmp_path / "other.yaml"
    other.write_text(f"{quick_config.read_text('utf-8')}\nledger: {{line: line 9}}\n", "utf-8")
    for words in (("status",), ("send", "start")):
        refused = run(*words, "-c", other, "--runs", runs)
        assert refused.returncode == 2
        assert "--config is of line 'line 9', the cell of" in refused.stderr
    assert run("send", "stop", "-c", tmp_path / "none.yaml").returncode == 2
    made = client.send(Request(MachineEvent.START, "plc", product="x"))
    assert "no products; leave it out" in made.reason
    assert "; in this run: 2 inserted" in run("status", "--runs", runs).stdout
    shown = json.loads(run("status", "--runs", runs, "--json").stdout)
    assert shown["counts"] == {"inserted": 2}
    assert shown["last"]["part"] == "A-2"
    assert client.send(Request(MachineEvent.START, "plc")).state is CellState.STARTING
    until(client, in_step("lower"))
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    waits = f"idle: waits for start (`cell send start --runs {runs}`, or Start on the page)"
    assert err.decode().count(waits) == 1
    assert [json.loads(line)["outcome"] for line in out.splitlines()] == ["inserted"] * 3
    assert all(read_record(folder).closed for folder in runs.iterdir())
    assert run("status", "--runs", runs).returncode == 3
    hearing.join(30)
    assert not hearing.is_alive(), said
    assert {b"READY=1", b"WATCHDOG=1", b"STATUS=idle, cycle 1"} <= set(said)
    told.close()


def test_after_a_kill_nothing_moves_until_a_person_says_so(start: Start, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    killed = start()
    client = Client(runs).connect(wait_s=60.0)
    until(client, waits_for("start"))
    client.send(Request(MachineEvent.START, "plc", part="A-1"))
    until(client, in_step("hold_and_capture"))
    killed.kill()
    killed.wait(30)
    Record(runs, 1, datetime(2001, 1, 1))  # another one, from before the clock was set

    again = start()
    status = client.connect(wait_s=60.0).status()
    assert status.state is CellState.STOPPED
    assert status.waiting_for == ("acknowledgement",)
    assert status.fault is not None and "cycle 1 was not finished" in status.fault.cause
    shown = run("status", "--runs", runs)
    assert shown.returncode == 1
    assert "cycle 1 was not finished" in shown.stdout
    assert status.fault.cause.endswith("not acknowledged either: cycles 1")
    refused = client.send(Request(MachineEvent.START, "plc"))
    assert (
        "'start' is refused while stopped; possible now: acknowledge, reset, abort"
        in refused.reason
    )
    assert client.status().state is CellState.STOPPED
    assert run("send", "reset", "--by", "Ada", "--note", "looked", "--runs", runs).returncode == 0
    until(client, waits_for("start"))
    assert client.status().fault is None
    said = [read_record(folder).state["acknowledged"] for folder in runs.iterdir()]
    assert said == [{"by": "Ada", "note": "looked"}] * 2
    client.send(Request(MachineEvent.STOP, "plc"))
    until(client, waits_for("acknowledgement"))
    assert len([f for f in runs.iterdir() if f.is_dir()]) == 2
    assert client.send(Request(MachineEvent.RESET, "Ada")).accepted
    until(client, waits_for("start"))
    client.send(Request(MachineEvent.START, "plc"))
    until(client, in_step("lower"))
    client.send(Request(MachineEvent.STOP, "plc", "guard opened"))
    until(client, waits_for("acknowledgement"))
    again.send_signal(signal.SIGTERM)
    again.communicate(timeout=60)
    assert again.returncode == 0
    ledger = Ledger(runs)
    *killed_cycles, stopped_cycle = ledger.listed(LedgerQuery())
    ledger.close()
    assert {c.part for c in killed_cycles} == {"A-1", None}
    assert [(c.acknowledged.by, c.acknowledged.note) for c in killed_cycles] == [
        ("Ada", "looked; reset by Ada")
    ] * 2
    assert (stopped_cycle.cycle, stopped_cycle.fault.code) == (2, "stop")

    start()  # a restart is no acknowledgement
    status = client.connect(wait_s=60.0).status()
    assert status.state is CellState.STOPPED
    assert status.fault is not None and status.fault.cause == "guard opened by plc"


def test_after_a_kill_while_it_is_made_ready_nothing_moves(start: Start, tmp_path: Path) -> None:
    """It reset by itself: a gripper that was moving, or a cable in the jaws, nobody had looked
    at."""
    killed = start()
    client = Client(tmp_path / "runs").connect(wait_s=60.0)
    until(client, in_step("warm_up"))
    killed.kill()
    killed.wait(30)
    start()
    status = client.connect(wait_s=60.0).status()
    assert (status.state, status.waiting_for) == (CellState.STOPPED, ("acknowledgement",))
    assert status.fault is not None and "while the cell was made ready" in status.fault.cause
    assert client.send(Request(MachineEvent.RESET, "Ada", "jaws are empty")).accepted
    until(client, waits_for("start"))
    assert client.status().fault is None


def test_a_stop_in_idle_outlives_the_service(start: Start, tmp_path: Path) -> None:
    """It had no record, and the next service reset by itself."""
    stopped = start()
    client = Client(tmp_path / "runs").connect(wait_s=60.0)
    until(client, waits_for("start"))
    client.send(Request(MachineEvent.STOP, "plc", "guard opened"))
    until(client, waits_for("acknowledgement"))
    stopped.kill()
    stopped.wait(30)
    start()
    status = client.connect(wait_s=60.0).status()
    assert (status.state, status.waiting_for) == (CellState.STOPPED, ("acknowledgement",))
    assert status.fault is not None and "guard opened" in status.fault.cause
    assert client.send(Request(MachineEvent.RESET, "Ada", "guard closed")).accepted
    until(client, waits_for("start"))


def test_a_run_of_so_many_cycles_can_be_looked_at_and_takes_no_start(
    start: Start, tmp_path: Path
) -> None:
    process = start("1")
    client = Client(tmp_path / "runs").connect(wait_s=60.0)
    answer = client.send(Request(MachineEvent.START, "plc"))
    assert not answer.accepted
    assert "--cycles forever" in answer.reason
    until(client, in_step("lower"))
    assert client.send(Request(MachineEvent.HOLD, "plc")).accepted
    until(client, waits_for("unhold"))
    assert client.send(Request(MachineEvent.UNHOLD, "plc")).accepted
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert json.loads(out)["outcome"] == "inserted"
