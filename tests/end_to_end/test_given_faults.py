"""Faults that a person gives to `cell emulate`; and an emulator that dies is noticed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import pytest

from tests.command import run_cell
from tests.waiting import wait_until

from .conftest import run, unrecorded

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")


class Emulators:
    """A `cell emulate`, somebody who types there, and what it says on its error stream."""

    def __init__(self, config: Path, said: Path, *options: str) -> None:
        self.config, self._said = config, said
        command = [sys.executable, "-m", "cell", "emulate", "-c", str(config), *options]
        with said.open("w", encoding="utf-8") as errors:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
            )
        assert self.process.stdout is not None
        self.pids = {}
        for _ in range(3):
            device, where = self.process.stdout.readline().split(maxsplit=1)
            self.pids[device] = int(where.rpartition("process ")[2].rstrip(")\n"))

    def type(self, line: str) -> None:
        keyboard: IO[str] | None = self.process.stdin
        assert keyboard is not None
        keyboard.write(line + "\n")
        keyboard.flush()

    def says(self, text: str) -> None:
        wait_until(lambda: text in self._said.read_text("utf-8"), 10.0, self._said.read_text)

    def run(self, runs: Path) -> dict[str, Any]:
        done = run("run", "-c", self.config, "--json", "--runs", runs)
        assert done.stdout, done.stderr
        result: dict[str, Any] = json.loads(done.stdout)
        return result


@pytest.fixture
def emulators(light_config: Path, tmp_path: Path) -> Iterator[Callable[..., Emulators]]:
    started: list[Emulators] = []
    config = tmp_path / "light.yaml"
    shutil.copy(light_config, config)
    unrecorded(config)

    def start(*options: str) -> Emulators:
        started.append(Emulators(config, tmp_path / "said.txt", *options))
        return started[-1]

    yield start
    for one in started:
        one.process.kill()
        one.process.communicate(timeout=30)


@pytest.mark.real_time
def test_a_fault_comes_when_it_was_told_to_and_can_be_repaired(
    emulators: Callable[..., Emulators], tmp_path: Path
) -> None:
    """The camera is lost in the swing; repaired, the next cable goes through."""
    it = emulators("--fault", "camera.lost@1.2s")
    it.says("camera.lost 1.2 s after a cable is gripped: waits for a cable")
    failed = it.run(tmp_path / "runs")
    assert failed["outcome"] == "failed"
    assert failed["fault"]["device"] == "camera"
    assert failed["fault"]["step"] in ("lower", "hold_and_capture")
    it.says("camera.lost: its connection breaks off")
    it.type("camera.lots")
    it.says("'camera.lots': there is no fault camera.lots; is it camera.lost?")
    it.type("arm.protective_stop")
    it.says("arm.protective_stop: the controller stops the arm")
    it.type("repair")
    it.says("all faults are repaired")
    assert it.run(tmp_path / "runs")["fault"] is None

    os.kill(it.pids["gripper"], signal.SIGKILL)
    assert it.process.wait(10.0) == 1
    it.says(f"the emulated gripper (process {it.pids['gripper']}) has ended; so do the others")
    it.says("start them again with `cell emulate --config")


def test_a_dead_arm_is_noticed_while_nobody_uses_it(emulators: Callable[..., Emulators]) -> None:
    it = emulators()
    os.kill(it.pids["arm"], signal.SIGKILL)
    assert it.process.wait(10.0) == 1
    it.says(f"the emulated arm (process {it.pids['arm']}) has ended")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("camera", "there is no fault camera"),
        ("camera.lost@", "must be a fault and a time, like camera.lost@2s"),
        ("camera.lost@2ms", "must be a fault and a time"),
        ("camera.lost@1e9s", "must be a fault and a time"),
        ("camera.lost@99999s", "at most 3600 s after a cable is gripped"),
        ("kamera.lost", "is it camera.lost?"),
    ],
)
def test_a_fault_that_is_none_is_refused_before_anything_starts(
    light_config: Path, fault: str, message: str
) -> None:
    done = run_cell("emulate", "-c", light_config, "--fault", fault, code=2)
    assert done.stderr.startswith(f"--fault '{fault}': ") and message in done.stderr
