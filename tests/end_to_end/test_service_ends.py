"""How a service ends, and what the next one then says: a signal, a kill, a device that fails."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.plant.client import Client
from cell.plant.messages import Request, Status
from cell.run.machine import CellState, MachineEvent
from tests.waiting import free_port, listens, wait_until

from .conftest import run
from .forked import Forked
from .test_service import Start, in_step, start, until, waits_for

__all__ = ["start"]


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Client]:
    client = Client(tmp_path / "runs")
    yield client
    client.close()


def ended(process: Forked) -> list[tuple[str, str | None]]:
    """Outcome and cause of every cycle that a service had told of when it ended."""
    out, _ = process.communicate(timeout=60)
    results = [json.loads(line) for line in out.splitlines()]
    return [(r["outcome"], r["fault"] and r["fault"]["cause"]) for r in results]


def children(process: int) -> list[int]:
    """Adapters of a service."""
    threads = Path(f"/proc/{process}/task").glob("*/children")
    pids = [int(pid) for file in threads for pid in file.read_text().split()]
    return [p for p in pids if b"cell.plant.child" in Path(f"/proc/{p}/cmdline").read_bytes()]


def waits_for_a_person(client: Client) -> Status:
    """Status of a service that has just begun, and must not move."""
    status = client.connect(wait_s=60.0).status()
    assert (status.state, status.waiting_for) == (CellState.STOPPED, ("acknowledgement",))
    shown = run("status", "--runs", client.path.with_name("runs"))
    assert shown.returncode == 1
    assert status.fault is not None and status.fault.cause in shown.stdout
    return status


def test_a_kill_in_idle_or_ctrl_c_there_leaves_nothing_that_a_person_must_look_at(
    start: Start, client: Client, tmp_path: Path
) -> None:
    """The jaws are empty and the gripper is home: the next service makes itself ready."""
    for number, code in ((signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 0)):
        process = start()
        client.connect(wait_s=60.0)
        until(client, waits_for("start"))
        assert client.status().fault is None
        assert not (tmp_path / "runs.unsettled").exists()
        process.send_signal(number)
        assert ended(process) == []
        assert process.returncode == code
        assert not (tmp_path / "runs.unsettled").exists()
    assert not (tmp_path / "runs").exists()


def test_sigterm_while_held_stops_the_cycle_where_it_is(start: Start, client: Client) -> None:
    process = start()
    client.connect(wait_s=60.0)
    until(client, waits_for("start"))
    client.send(Request(MachineEvent.START, "plc", part="A-1"))
    until(client, in_step("lower"))
    client.send(Request(MachineEvent.HOLD, "plc"))
    until(client, waits_for("unhold"))
    process.send_signal(signal.SIGTERM)
    assert ended(process) == [("failed", "the service ends")]
    assert process.returncode == 0
    process = start()
    fault = waits_for_a_person(client).fault
    assert fault is not None
    assert (fault.cycle, fault.cause, fault.code) == (1, "the service ends", "stop")
    process.send_signal(signal.SIGTERM)
    assert ended(process) == []
    assert process.returncode == 0


def test_ctrl_c_stops_a_cycle_and_the_next_service_waits(start: Start, client: Client) -> None:
    process = start()
    client.connect(wait_s=60.0)
    until(client, waits_for("start"))
    client.send(Request(MachineEvent.START, "plc"))
    until(client, in_step("lower"))
    process.send_signal(signal.SIGINT)
    assert ended(process) == [("failed", "interrupted by a person")]
    assert process.returncode == 130
    process = start()
    fault = waits_for_a_person(client).fault
    assert fault is not None
    assert (fault.cycle, fault.step, fault.code) == (1, "lower", "stop")
    assert client.send(Request(MachineEvent.RESET, "Ada", "cable taken out")).accepted
    until(client, in_step("warm_up"))
    process.send_signal(signal.SIGINT)  # the gripper may be moving: somebody has to look again
    assert ended(process) == [("failed", "interrupted by a person")]


def test_an_adapter_is_kept_running_and_dies_with_the_service(
    start: Start, client: Client, quick_config: Path, tmp_path: Path
) -> None:
    port = free_port()
    plant = f"\nplant: {{start: [handshake], handshake: {{port: {port}}}}}\n"
    config = tmp_path / "plant.yaml"
    config.write_text(quick_config.read_text(encoding="utf-8") + plant, encoding="utf-8")
    process = start(config=config)
    client.connect(wait_s=60.0)
    wait_until(lambda: listens(port))
    [adapter] = children(process.pid)
    os.kill(adapter, signal.SIGKILL)
    wait_until(lambda: bool(client.status().adapters))
    shown = run("status", "--runs", tmp_path / "runs").stdout
    assert "adapter handshake has ended: signal 9" in shown
    wait_until(lambda: listens(port) and adapter not in children(process.pid))
    until(client, waits_for("start"))
    process.kill()
    process.wait(30)
    wait_until(lambda: not listens(port))
    process = start(config=config)
    client.connect(wait_s=60.0)
    wait_until(lambda: listens(port))
    assert client.status().adapters == {}
    until(client, waits_for("start"))
    process.send_signal(signal.SIGTERM)
    assert ended(process) == []
    assert process.returncode == 0
    assert not listens(port)


@pytest.mark.real_time
def test_a_device_that_fails_in_idle_aborts_and_is_recorded(
    start: Start, client: Client, light_config: Path, tmp_path: Path
) -> None:
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")
    emulate = [sys.executable, "-m", "cell", "emulate", "-c", str(light_config)]
    at = subprocess.Popen(emulate, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert at.stdin is not None and at.stdout is not None
        for _ in range(3):
            at.stdout.readline()
        process = start(config=light_config)
        client.connect(wait_s=60.0)
        until(client, waits_for("start"))
        print("arm.protective_stop", file=at.stdin, flush=True)
        wait_until(lambda: client.status().fault is not None)
        status = client.status()
        assert (status.state, status.waiting_for) == (CellState.ABORTED, ("acknowledgement",))
        assert status.fault is not None
        assert (status.fault.cycle, status.fault.step) == (1, "idle")
        assert status.fault.device == "arm"
        refused = client.send(Request(MachineEvent.START, "plc"))
        assert "possible now: acknowledge, clear" in refused.reason
        process.kill()
        ended(process)
        process = start(config=light_config)
        again = waits_for_a_person(client).fault
        assert again is not None
        assert (again.step, again.cause) == (status.fault.step, status.fault.cause)
        print("repair", file=at.stdin, flush=True)
        assert client.send(Request(MachineEvent.RESET, "Ada", "released")).accepted
        until(client, waits_for("start"))
        process.send_signal(signal.SIGTERM)
        assert ended(process) == []
    finally:
        at.kill()
        at.communicate(timeout=30)
