"""What users expect of any command line: --version, completion, init, --json and -o everywhere."""

import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from cell.cli import app
from cell.cli.output import Json, JsonCommand
from cell.settings import load_settings


def cell(*arguments: object, given: str | None = None):
    return CliRunner().invoke(app, [str(a) for a in arguments], input=given)


def test_the_version_is_printed() -> None:
    done = cell("--version")
    assert done.exit_code == 0
    assert done.stdout.startswith("cell 0.") and "Python 3." in done.stdout


def test_shells_can_complete() -> None:
    assert "--install-completion" in cell("--help").stdout
    done = CliRunner().invoke(
        app, env={"_CELL_COMPLETE": "complete_bash", "COMP_WORDS": "cell dia", "COMP_CWORD": "1"},
        prog_name="cell",
    )  # fmt: skip
    assert done.stdout.split() == ["diagnose"]


@pytest.mark.parametrize("real", [[], ["--emulated"], ["--real"]])
def test_init_asks_nothing_without_a_terminal_and_the_file_checks(real, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    done = cell("init", "-o", path, *real)
    assert (done.exit_code, done.stdout) == (
        0,
        f"{path}: written; next: cell check --config {path}\n",
    )
    assert cell("check", "--config", path).exit_code == 0
    before = path.read_text()
    again = cell("init", "-o", path)
    assert again.exit_code == 2 and "exists already" in again.stderr
    assert path.read_text() == before


def test_init_takes_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cell.cli.settings._is_interactive", lambda: True)
    path = tmp_path / "mine.yaml"
    answers = ["0.12", "", "", "", "", "", "-0.05, 0.02", ""]
    done = cell("init", "-o", path, given="\n".join(answers) + "\n")
    assert done.exit_code == 0, done.output
    settings = load_settings(path)
    assert settings.cable.free_length_m == 0.12
    assert settings.limits.x_m == (-0.05, 0.02)


def test_init_checks_each_answer_when_it_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They were checked after the last one, all were lost with the first wrong one."""
    monkeypatch.setattr("cell.cli.settings._is_interactive", lambda: True)
    path = tmp_path / "mine.yaml"
    wrong_and_right = [
        *("100", "-3", "0.12", "", "", "", "0.3", "a, [", "-0.135, -0.13", "", "", ""),
        *("not a host!", "10.0.0.300", "robot-1.local", "UR7", "UR5e", "", ""),
    ]
    done = cell("init", "-o", path, "--real", given="\n".join(wrong_and_right) + "\n")
    assert done.exit_code == 0, done.output
    settings = load_settings(path)
    assert settings.cable.free_length_m == 0.12
    assert settings.arm.kind == "ur" and settings.arm.host == "robot-1.local"
    assert [line.split(": ")[0] for line in done.stderr.splitlines()] == [
        *("cable.free_length_m", "cable.free_length_m", "destination.x_m[1]", "destination.x_m"),
        *("arm.host", "arm.host", "arm.model"),
    ]
    assert "less than or equal to 2 (got 100); give metres, not millimetres" in done.stderr
    assert "'10.0.0.300' is no address; give a name or an IP address" in done.stderr


def test_init_writes_nothing_if_the_answers_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.cli.settings._is_interactive", lambda: True)
    done = cell("init", "-o", tmp_path / "no.yaml", given="-3\n")
    assert done.exit_code != 0
    assert "cable.free_length_m: input should be greater than 0" in done.stderr
    assert not (tmp_path / "no.yaml").exists()


@pytest.mark.parametrize(("height", "told"), [(1.0, False), (-1.0, True)])
def test_a_y_axis_that_points_down_is_noted(tmp_path: Path, height: float, told: bool) -> None:
    path = tmp_path / "mine.yaml"
    cell("init", "-o", path, "--real")
    text = path.read_text()
    axis = "plane_y_axis: [0.0, 0.0, 1.0]"
    assert axis in text
    path.write_text(text.replace(axis, f"plane_y_axis: [0.0, 0.0, {height}]"))
    done = cell("check", "--config", path)
    assert done.exit_code == 0
    assert ("points down in the arm's base frame, and y is up" in done.stderr) is told


def json_places(*arguments: str) -> str:
    tried = typer.Typer()

    @tried.command(cls=JsonCommand)
    def fit(study: Path, as_json: Json = None, flag: bool = False) -> None:
        print(study, as_json, flag)

    done = CliRunner().invoke(tried, list(arguments))
    return done.stdout.strip() if done.exit_code == 0 else f"exit {done.exit_code}"


@pytest.mark.parametrize(
    ("given", "understood"),
    [
        ("S", "S None False"),
        ("S --json", "S - False"),
        ("--json S", "S - False"),
        ("S --json --flag", "S - True"),
        ("S --json -", "S - False"),
        ("S --json out.json", "S out.json False"),
        ("--json out.json S", "S out.json False"),
        ("S --json=out.json", "S out.json False"),
        ("--json", "exit 2"),
        ("S --json a b", "exit 2"),
    ],
)
def test_json_prints_and_with_a_file_writes(given: str, understood: str) -> None:
    assert json_places(*given.split()) == understood


def test_effects_as_json_are_printed_alone_or_written_beside_the_table(tmp_path: Path) -> None:
    printed = cell("effects", "--json")
    listed = json.loads(printed.stdout)["effects"]
    assert {"air_drag", "tip_mass"} <= {e["effect"] for e in listed}
    path = tmp_path / "effects.json"
    written = cell("effects", "-o", path)
    assert json.loads(path.read_text())["effects"] == listed
    assert "[kg/m]" in written.stdout


def test_past_cycles_of_no_folder_end_with_2(tmp_path: Path) -> None:
    for command in (("list", tmp_path / "no"), ("show", "--runs", tmp_path), ("show", tmp_path)):
        done = cell(*command)
        assert done.exit_code == 2 and done.stderr and not done.stdout


def test_a_folder_without_cycles_is_said_to_have_none(tmp_path: Path) -> None:
    done = cell("list", tmp_path)
    assert (done.exit_code, done.stdout.startswith(f"{tmp_path}: has no cycles")) == (0, True)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("free_length_m: 0.1\n", 'free_length_m: "0,1"\n', "; write a decimal point, 0.1"),
        ("free_length_m: 0.1\n", "free_length_m: .nan\n", "must be a finite number (got nan)"),
        (
            "effects: {}",
            "effects: {air_drag: {drag_coefficient: -5}}",
            "drag_coefficient = -5: must be 0 … 50\n",
        ),
    ],
)
def test_a_number_that_is_none_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "cell.yaml"
    assert cell("init", "-y", "-o", path).exit_code == 0
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    done = cell("check", "-c", path)
    assert (done.exit_code, said in done.stderr) == (2, True), done.stderr


def test_the_log_of_any_command_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "lab.log"
    assert cell("--log", path, "effects").exit_code == 0
    first, second = path.read_text().splitlines()
    assert "cell 0." in first and first.endswith(f"log of {path}")
    assert " INFO    cell.cli: cell " in second
