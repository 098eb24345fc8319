"""Adapters that the service keeps running: started again, told once, ended with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from cell.plant import children
from cell.plant.children import NICE, Adapters
from tests.waiting import free_port, is_alive, wait_until

Told = list[tuple[str, str]]

#: Writes that it was begun, then does what the test says.
PROGRAM = (
    "import os, sys, time, signal; print(os.getpid(), file=open(sys.argv[1], 'a'), flush=True)"
)


def command(file: Path, then: str) -> list[str]:
    return [sys.executable, "-c", f"{PROGRAM}\n{then}", str(file)]


def begun(file: Path) -> list[int]:
    """Processes that were begun."""
    return [int(line) for line in file.read_text().splitlines()] if file.exists() else []


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(children, "FIRST_S", 0.01)
    monkeypatch.setattr(children, "LONGEST_S", 0.04)
    monkeypatch.setattr(children, "TAKE_S", 0.0)


def test_one_that_ends_is_started_again_and_told_of_once(tmp_path: Path) -> None:
    told: Told = []
    file = tmp_path / "begun"
    commands = {
        "mqtt": command(file, "sys.exit(3)"),
        "opcua": [str(tmp_path / "no program")],
    }
    with closing(Adapters(commands, lambda *said: told.append(said))) as adapters:
        adapters.start()
        wait_until(lambda: len(begun(file)) >= 4 and len(told) == 2)
    said = dict(told)
    assert said["mqtt"].startswith("has ended: exit code 3; it is started again")
    assert "No such file" in said["opcua"]
    assert len(told) == 2


def test_pauses_grow_to_the_longest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    adapters = Adapters({"mqtt": [str(tmp_path / "no program")]}, lambda *said: None)
    [kept] = adapters._adapters
    wait = kept._over.wait

    def waited(pause_s: float) -> bool:
        pauses.append(pause_s)
        return wait(pause_s)

    monkeypatch.setattr(kept._over, "wait", waited)
    with closing(adapters):
        adapters.start()
        wait_until(lambda: len(pauses) >= 4)
    assert pauses[:4] == [0.01, 0.02, 0.04, 0.04]


def test_one_that_runs_for_long_enough_is_well_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(children, "WELL_S", 0.3)
    told: Told = []
    file = tmp_path / "begun"
    once = command(file, "sum(1 for _ in open(sys.argv[1])) < 2 and sys.exit(1)\ntime.sleep(60)")
    adapters = Adapters({"mqtt": once}, lambda *said: told.append(said))
    with closing(adapters):
        adapters.start()
        wait_until(lambda: len(told) == 2 and len(begun(file)) == 2)
    assert told[1] == ("mqtt", "")
    assert not any(map(is_alive, begun(file)))


def test_one_that_does_not_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(children, "END_S", 0.3)
    file = tmp_path / "begun"
    stubborn = command(file, "signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)")
    adapters = Adapters({"a": stubborn, "b": stubborn}, lambda *said: None)
    adapters.start()
    wait_until(lambda: len(begun(file)) == 2)
    begun_s = time.monotonic()
    adapters.close()
    assert not any(map(is_alive, begun(file)))
    assert time.monotonic() - begun_s < 10.0


def test_a_child_computes_after_others_and_dies_with_its_parent(tmp_path: Path) -> None:
    program = (
        "import subprocess, sys, os, time\n"
        "child = [sys.executable, '-m', 'cell.plant.children', str(os.getpid())]\n"
        "at = subprocess.Popen([*child, 'handshake', '--config', sys.argv[1]])\n"
        "print(at.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    settings = tmp_path / "cell.yaml"
    fake = Path(__file__).parents[3] / "config" / "fake.yaml"
    text = fake.read_text() + "\nplant: {handshake: {port: 0}}\n"
    settings.write_text(text.replace("port: 0", f"port: {free_port()}"))
    parent = subprocess.Popen(
        [sys.executable, "-c", program, str(settings)], stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    wait_until(lambda: os.getpriority(os.PRIO_PROCESS, child) == NICE)
    parent.send_signal(signal.SIGKILL)
    parent.communicate()
    wait_until(lambda: not is_alive(child))
