"""The whole cycle through the real clients: RTDE over TCP, Modbus on a serial line, a stream."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.rtde_wire import FAULT_PORT
from tests.waiting import wait_until

from .conftest import run, unrecorded

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")

CONFIG = Path(__file__).parents[2] / "config" / "emulated.yaml"


def cell(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "cell", *map(str, arguments)]


def host_of(config: Path) -> str:
    (line,) = [s for s in config.read_text(encoding="utf-8").splitlines() if "host:" in s]
    return line.split()[1]


def is_silent(config: Path) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((host_of(config), FAULT_PORT)) != 0


def eventually_silent(config: Path) -> None:
    why = "the emulators outlived whoever started them"
    wait_until(lambda: is_silent(config), 10.0, lambda: why)


@pytest.mark.real_time
def test_a_cable_is_inserted_by_the_one_command(light_config: Path, tmp_path: Path) -> None:
    """Its own emulators, one cycle, and nobody left behind."""
    command = cell("run", "--config", light_config, "--json", "--runs", tmp_path)
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    result = json.loads(done.stdout) if done.stdout else {}
    assert result.get("outcome") == "inserted", f"{result.get('reason')} {done.stderr}"
    assert result["prediction_error_m"] < 2e-3
    assert done.returncode == 0
    eventually_silent(light_config)


@pytest.mark.real_time
def test_an_insertion_is_watched_in_flight(light_config: Path, tmp_path: Path) -> None:
    """With feedback: what the cable answers is known in time, and the arm's path stays its own."""
    config = tmp_path / "seeing.yaml"
    config.write_text(light_config.read_text(encoding="utf-8") + "\nfeedback: on\n")
    done = run("run", "--config", unrecorded(config), "--json", "--runs", tmp_path / "runs")
    result = json.loads(done.stdout) if done.stdout else {}
    assert result.get("outcome") == "inserted", f"{result.get('reason')} {done.stderr}"
    assert result["corrections"] is not None
    assert result["prediction_error_m"] < 2e-3
    eventually_silent(light_config)


@pytest.fixture
def emulating(light_config: Path) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        cell("emulate", "--config", light_config), stdout=subprocess.PIPE, text=True
    )
    yield process
    process.kill()
    process.communicate(timeout=30)
    eventually_silent(light_config)


def test_emulators_can_be_started_beforehand_and_end_with_ctrl_c(
    light_config: Path, emulating: subprocess.Popen[str]
) -> None:
    assert emulating.stdout is not None
    said = [emulating.stdout.readline() for _ in range(3)]
    assert [line.split()[0] for line in said] == ["arm", "camera", "gripper"]
    assert host_of(light_config) in said[0] and "RTDE 30004" in said[0]
    assert not is_silent(light_config)
    emulating.send_signal(signal.SIGINT)
    assert emulating.wait(15.0) == 0
    eventually_silent(light_config)


def test_emulators_end_with_whoever_started_them(light_config: Path) -> None:
    program = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen({cell('emulate', '--config', light_config)!r}, "
        "stdout=subprocess.PIPE, text=True)\n"
        "print(child.stdout.readline(), flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    assert parent.stdout.readline().startswith("arm")
    parent.kill()
    parent.communicate(timeout=30)
    eventually_silent(light_config)


def test_addresses_that_are_taken_are_named_and_end_with_2(
    light_config: Path, tmp_path: Path
) -> None:
    with socket.create_server((host_of(light_config), 5600)):
        done = run("run", "--config", light_config, "--runs", tmp_path / "runs")
    assert done.returncode == 2
    assert f"{light_config}:1: emulated: the emulated camera: OSError" in done.stderr
    assert "in use" in done.stderr
    assert not (tmp_path / "runs").exists()


def test_settings_of_real_devices_are_not_emulated(tmp_path: Path) -> None:
    fake = run("emulate", "--config", CONFIG.with_name("fake.yaml"))
    assert fake.returncode == 2
    assert "arm.kind: this cell is simulated and needs no emulators; `cell init" in fake.stderr
    line3 = CONFIG.with_name("line3.yaml")
    done = run("emulate", "--config", line3)
    assert done.returncode == 2
    assert f"{line3}:1: emulated: is missing; add `emulated: {{}}`" in done.stderr
