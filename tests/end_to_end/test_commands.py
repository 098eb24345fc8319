"""The commands as a user gives them: exit codes, JSON, what is printed where, and being killed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.records.folder import read_record
from cell.settings import Settings

from .conftest import said
from .forked import Forked, Forking

FIELDS = {
    "cycle",
    "outcome",
    "offset_m",
    "predicted_miss_m",
    "measured_miss_m",
    "margin_m",
    "seconds",
    "folder",
}


@pytest.fixture(scope="module")
def inserted(quick_config: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder and standard output of a run of one cable with --json."""
    runs = tmp_path_factory.mktemp("runs")
    code, out, err = said("run", "--config", quick_config, "--json", "--runs", runs)
    assert (code, err) == (0, "")
    return runs, out


def test_json_is_one_object_per_cycle_and_nothing_else(inserted: tuple[Path, str]) -> None:
    (line,) = inserted[1].splitlines()
    result = json.loads(line)
    assert set(result) >= FIELDS
    assert (result["cycle"], result["outcome"]) == (1, "inserted")
    assert {"grasp", "identify", "execute"} <= set(result["seconds"])
    assert Path(result["folder"]).parent == inserted[0]


def test_identification_is_repeated_from_the_folder_alone(inserted: tuple[Path, str]) -> None:
    (folder,) = inserted[0].iterdir()
    code, out, _ = said("identify", folder, "--json")
    assert code == 0
    model, recorded = json.loads(out), read_record(folder).model
    assert recorded is not None
    for again, before in zip(model["parameters"], recorded["parameters"], strict=True):
        assert again["name"] == before["name"]
        # It begins without what was computed early, and ends within the fit's own tolerance.
        interval = before["high"] - before["low"]
        assert abs(again["value"] - before["value"]) <= 0.05 * interval
    code, out, _ = said("identify", folder / "study")
    assert code == 0 and "viscosity" in out and "mm rms" in out


def test_a_table_is_printed_for_people(quick_config: Path, tmp_path: Path) -> None:
    code, out, _ = said("run", "-c", quick_config, "--runs", tmp_path / "runs")
    assert code == 0
    for words in ("offset", "predicted", "measured", "margin", "hold and capture", "robot waited"):
        assert words in out
    assert "…" not in out, "80 columns are enough for every heading and number"


def test_bad_settings_end_with_2_and_nothing_is_written(quick_config: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.yaml"
    text = quick_config.read_text(encoding="utf-8")
    bad.write_text(text.replace("force_n: 20.0", "force: 20.0"), encoding="utf-8")
    for command in (("run", "--runs", tmp_path / "runs"), ("check",)):
        code, out, err = said(command[0], "--config", bad, *command[1:])
        assert (code, out) == (2, "")
        assert f"{bad}:47:3: gripper.force: unknown key; did you mean 'force_n'?" in err
    assert not (tmp_path / "runs").exists()


def test_hardware_that_is_not_there_fails_by_name_and_ends_with_1(tmp_path: Path) -> None:
    line3 = Path(__file__).parents[2] / "config" / "line3.yaml"
    code, out, err = said("check", "--config", line3)
    assert code == 0 and "arm ur" in out
    absent = tmp_path / "line3.yaml"
    text = line3.read_text(encoding="utf-8").replace("/dev/ttyUSB0", str(tmp_path / "no_port"))
    text = text.replace("[0.450,", "[0.451,").replace("origin_row_px: 150", "origin_row_px: 151")
    absent.write_text(text, encoding="utf-8")
    code, out, err = said("run", "--config", absent, "--json", "--runs", tmp_path / "runs")
    assert code == 1
    result = json.loads(out)
    assert (result["outcome"], result["fault"]["step"]) == ("failed", "connect")
    assert result["fault"]["device"] == "gripper" and result["fault"]["remedy"]
    assert "cable 1 failed in step connect: gripper: " in err
    assert "not yet of your cell: cable.free_length_m, " in err and "arm.tcp; measure them" in err


def test_a_rejected_cable_ends_with_1_and_its_reason(quick_config: Path, tmp_path: Path) -> None:
    high = tmp_path / "high.yaml"
    text = quick_config.read_text(encoding="utf-8")
    high.write_text(text.replace("[-0.111, -0.101]", "[-0.065, -0.055]"), encoding="utf-8")
    code, out, err = said("run", "-c", high, "--json", "--runs", tmp_path / "runs")
    assert code == 1
    assert json.loads(out)["outcome"] == "rejected"
    assert "cable 1 rejected: no offset passes" in err


def test_a_record_that_cannot_be_written_is_said_before_anything_moves(
    quick_config: Path, tmp_path: Path
) -> None:
    (tmp_path / "runs").write_text("a file where a folder should be")
    code, out, err = said("run", "-c", quick_config, "--json", "--runs", tmp_path / "runs")
    assert (code, out) == (2, "")
    assert "isafile;giveafolder" in "".join(err.replace("│", "").split())  # wrapped anywhere


def test_identify_says_what_is_wrong_with_a_folder(tmp_path: Path) -> None:
    code, out, err = said("identify", tmp_path)
    assert (code, out) == (2, "")
    assert "study.yaml:1:1: cannot be read" in err


def test_the_schema_is_printed_as_json() -> None:
    code, out, _ = said("schema")
    assert code == 0 and json.loads(out) == Settings.model_json_schema()


def test_help_names_the_exit_codes_and_is_quick() -> None:
    code, out, _ = said("run", "--help")
    assert code == 0
    assert "Exit codes: 0 if all cables were inserted" in out
    heavy = "import sys; import cell.cli; print(sorted({'numba','cv2','scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]", "help must not wait for heavy imports"


# --- being killed --------------------------------------------------------------------------------


@pytest.fixture
def running(forking: Forking, quick_config: Path, tmp_path: Path) -> Iterator[Forked]:
    words = ("--json", "--cycles", 50, "--runs", tmp_path / "runs")
    process = forking.start("run", "-c", quick_config, *words)
    yield process
    process.kill()
    process.wait(30)


def until_running(runs: Path, cycle: int) -> None:
    """Wait until a cycle is under way."""
    for _ in range(9000):
        if any(runs.glob(f"*-{cycle}/state.json")):
            return
        time.sleep(0.02)
    raise AssertionError("the run never came so far")


@pytest.mark.parametrize("given", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_arm_closes_the_record_and_gives_its_code(
    running: Forked, tmp_path: Path, given: signal.Signals
) -> None:
    until_running(tmp_path / "runs", 1)
    running.send_signal(given)
    out, err = (said.decode() for said in running.communicate(timeout=180))
    assert running.returncode == 128 + given, err
    last = json.loads(out.splitlines()[-1])
    assert last["outcome"] == "failed"
    assert last["fault"]["cause"] == "interrupted by a person"
    assert f"cable {last['cycle']} failed in step {last['fault']['step']}" in err
    read = read_record(Path(last["folder"]))
    assert read.closed and read.state["state"] == "stopped"
    assert read.state["arm"] in ("stopped", "lost"), "lost: not connected yet"


def test_a_killed_run_leaves_a_readable_record(running: Forked, tmp_path: Path) -> None:
    until_running(tmp_path / "runs", 2)
    running.kill()
    running.communicate(timeout=180)
    folders = sorted((tmp_path / "runs").iterdir(), key=lambda f: int(f.name.split("-")[-1]))
    assert len(folders) >= 2
    assert read_record(folders[0]).closed
    killed = read_record(folders[-1])
    assert not killed.closed and killed.result is None
    on_the_way = ("stopped", "resetting", "idle", "starting", "execute", "completing")
    assert killed.state["state"] in on_the_way
