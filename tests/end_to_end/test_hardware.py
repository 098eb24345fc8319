"""The conformance suite on devices that are there: these are emulated, and it cannot tell."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.settings import load_settings
from cell.wiring.emulated import EmulatedCell

from .conftest import run, unrecorded

ROOT = Path(__file__).parents[2]


def conformance(*options: object) -> tuple[int, str]:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-p", "no:cacheprovider"]
    command += ["tests/drivers/conformance", *map(str, options)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_a_device_that_is_not_there_is_no_pass(tmp_path: Path) -> None:
    absent = tmp_path / "absent.yaml"
    text = (ROOT / "config" / "line3.yaml").read_text(encoding="utf-8")
    absent.write_text(text.replace("/dev/ttyUSB0", str(tmp_path / "no_port")), encoding="utf-8")
    code, out = conformance("--hardware", "--config", absent, "-k", "grips_and_releases")
    assert code == 1 and "no gripper on" in out


def test_nothing_of_it_is_collected_without_being_asked_for() -> None:
    code, out = conformance("--collect-only")
    assert code == 0 and "hardware" not in out and "[sim]" in out


@pytest.mark.parametrize("options", [["--hardware"], ["--config", ROOT / "config" / "line3.yaml"]])
def test_one_option_without_the_other_is_refused(options: list[object]) -> None:
    code, out = conformance("--collect-only", *options)
    assert code == 4 and "--hardware and --config FILE go together" in out


# What needs these devices comes last: they take the processor's time until all are through.


@pytest.fixture(scope="module")
def config(light_config: Path) -> Iterator[Path]:
    """Settings of a cell that answers; nothing is recorded."""
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this machine")
    config = light_config.with_name("answers.yaml")
    shutil.copy(light_config, config)
    with EmulatedCell(load_settings(unrecorded(config)), seed=1):
        yield config


@pytest.mark.real_time
def test_arm_camera_and_gripper_of_the_settings_are_tested(config: Path) -> None:
    some = "logs_what_it_did or stop_in_motion or exactly_the_frames or grips_and_releases"
    code, out = conformance("--hardware", "--config", config, "-k", some, "-rA")
    assert code == 0, out
    passed = [line for line in out.splitlines() if line.startswith("PASSED")]
    assert len(passed) == 4 and all("[hardware]" in line for line in passed)
    assert {line.split("::")[0].rsplit("_", 1)[1] for line in passed} == {
        "arm.py",
        "camera.py",
        "gripper.py",
    }


@pytest.mark.real_time
def test_a_dry_run_finds_arm_and_camera_in_order(config: Path, tmp_path: Path) -> None:
    words = ("--dry-run", "--speed", "0.5", "--runs", tmp_path)
    done = run("run", "--config", config, "--json", *words)
    result = json.loads(done.stdout) if done.stdout else {}
    assert result.get("outcome") == "rehearsed", f"{result.get('reason')} {done.stderr}"
    found = {check["what"]: check["found"] for check in result["checks"]}
    assert found["camera: jaw detected in"] > 0.95
    assert found["gripper: largest speed"] == pytest.approx(0.24, abs=0.02)
