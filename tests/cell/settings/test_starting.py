"""Settings to start from are those that are shipped, and load with a comment beside each entry."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.settings import Settings, load_settings
from cell.settings.starting import (
    MEASURED,
    STARTING,
    answered,
    commented,
    default,
    questions,
    unmeasured,
)

CONFIG = Path(__file__).parents[3] / "config"


@pytest.mark.parametrize(("kind", "shipped"), [("simulated", "fake"), ("real", "line3")])
def test_what_init_starts_from_is_what_is_shipped(kind, shipped) -> None:
    made = Settings.model_validate(STARTING[kind]).model_dump()
    there = load_settings(CONFIG / f"{shipped}.yaml").model_dump()
    there["camera"] |= {"serial_number": None} if kind == "real" else {}
    assert made == there


@pytest.mark.parametrize("kind", ["simulated", "real"])
def test_the_file_loads_as_the_settings_and_explains_what_is_described(kind, tmp_path) -> None:
    settings = Settings.model_validate(STARTING[kind])
    path = tmp_path / "cell.yaml"
    text = commented(settings)
    path.write_text(text)
    assert load_settings(path) == settings
    assert max(len(line) for line in text.splitlines()) <= 130
    assert (
        "Duration of filming the swing, with the gripper held still; > 0, ≤ 30; default 1.0" in text
    )
    assert ("world:" in text) == (kind == "simulated")


def test_answers_take_the_place_of_defaults_and_leave_these_alone() -> None:
    assert ("arm", "host") in questions("real")
    assert ("arm", "host") not in questions("simulated")
    made = answered("real", {("arm", "host"): "10.0.0.5", ("cable", "free_length_m"): 0.12})
    assert made["arm"]["host"] == "10.0.0.5" and made["cable"]["free_length_m"] == 0.12
    assert default("real", ("arm", "host")) == "192.168.3.10"
    assert default("simulated", ("cable", "free_length_m")) == 0.1


def test_what_is_still_the_example_of_another_cell_is_named() -> None:
    """`cell check` called a real cell's file right in which nothing was measured."""
    example = Settings.model_validate(STARTING["real"])
    assert unmeasured(example) == tuple(".".join(map(str, key)) for key in MEASURED)
    answers = {("arm", "host"): "10.0.0.5", ("arm", "tcp"): [0.0, 0.0, 0.17, 0.0, 0.0, 0.0]}
    measured = Settings.model_validate(answered("real", answers))
    assert set(unmeasured(example)) - set(unmeasured(measured)) == {"arm.host", "arm.tcp"}
    for kind in ("simulated", "emulated"):
        assert unmeasured(Settings.model_validate(STARTING[kind])) == ()


def test_check_names_them() -> None:
    done = CliRunner().invoke(app, ["check", "--config", str(CONFIG / "line3.yaml")])
    assert done.exit_code == 0
    assert "line3.yaml: as in the example of `cell init --real`, so not yet of your cell: " in (
        done.stderr
    )
    assert "arm.plane_origin_m, camera.view; measure them (`cell help commission`)" in done.stderr


@pytest.mark.parametrize(
    ("command", "named"),
    [
        (["run"], ["arm.plane_origin_m", "camera.view"]),
        (["run", "--dry-run", "--speed", "0.1"], ["arm.plane_origin_m"]),
        (["calibrate", "cell"], ["arm.plane_origin_m"]),
    ],
)
def test_an_arm_whose_place_is_the_examples_does_not_move(
    command: list[str], named: list[str], tmp_path: Path
) -> None:
    config = CONFIG / "line3.yaml"
    lines = config.read_text("utf-8").splitlines()
    records = ["--runs", str(tmp_path / "runs")] if command[0] == "run" else []
    done = CliRunner().invoke(app, [*command, "--config", str(config), *records])
    assert done.exit_code == 2 and not (tmp_path / "runs").exists()
    complaints = [line for line in done.stderr.splitlines() if "line3.yaml:" in line]
    assert len(complaints) == len(named)
    for key, complaint in zip(named, complaints, strict=True):
        line = next(i for i, text in enumerate(lines, 1) if key.split(".")[1] in text)
        assert f"line3.yaml:{line}:3: {key}: has the value of the example" in complaint
        assert "measure that of this cell (`cell help commission`)" in complaint


def test_pictures_in_a_folder_are_calibrated_with_the_examples_place(tmp_path: Path) -> None:
    """Nothing moves then."""
    stored = f"calibration: {{folder: {tmp_path / 'stored'}}}\ncamera:\n"
    text = (CONFIG / "line3.yaml").read_text("utf-8").replace("camera:\n", stored)
    config = tmp_path / "line3.yaml"
    config.write_text("".join(li for li in text.splitlines(True) if "view:" not in li), "utf-8")
    command = ["calibrate", "camera", "--config", str(config)]
    done = CliRunner().invoke(app, [*command, "--from", str(tmp_path)])
    assert done.exit_code == 2 and "has no pictures" in done.stderr
    assert "arm.plane_origin_m" in CliRunner().invoke(app, command).stderr
