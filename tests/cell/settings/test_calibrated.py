"""A cell runs with a calibration that is there, fits, and is good and new enough; or not at all."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calib.store import StoredCalibration, save
from cell.cli import app
from cell.files.input_error import InputError
from cell.settings import load_settings
from cell.settings.calibrated import CIRCLE_95, calibrated, devices_of

NOW = datetime(2026, 3, 14, 12, 0, tzinfo=UTC)
TYPED = "  view: {metres_per_pixel: 0.0002, origin_column_px: 1000, origin_row_px: 150}\n"
HIDDEN = (
    "\nworld:\n  camera: {metres_per_pixel: 0.0002, origin_column_px: 1000, origin_row_px: 150}\n"
)


def config_of(tmp_path: Path, *, calibration: str | None = None, view: bool = False) -> Path:
    text = Path("config/fake.yaml").read_text()
    if not view:
        text = text.replace(TYPED, "")
    if calibration is not None:
        text = text.replace("\nworld:", f"\ncalibration: {calibration}\n{HIDDEN}")
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    return path


def files_for(settings) -> dict[str, StoredCalibration]:
    devices = devices_of(settings)
    common = {"made": NOW - timedelta(hours=2), "how": {}, "devices": devices}
    lens = [2600.0, 2600.0, 639.5, 511.5, -0.1, 0.0, 0.0, 0.0, 0.0]
    map_m = [[2e-4, 0.0, -0.2], [0.0, -2e-4, 0.03], [0.0, 0.0, 1.0]]
    return {
        "camera": StoredCalibration("camera", error={}, result={"lens": lens}, **common),
        "cell": StoredCalibration(
            "cell", error={"map_95_m": 3e-5}, result={"homography": map_m, "lens": lens}, **common
        ),
        "time": StoredCalibration(
            "time",
            error={"latency_95_s": 1e-4, "lag_95_s": 2e-4},
            result={"latency_s": 0.02, "lag_s": 0.034},
            **common,
        ),
    }


@pytest.fixture
def made(tmp_path):
    config = config_of(tmp_path, calibration=f"{{folder: {tmp_path / 'calibration'}}}")
    settings = load_settings(config)
    for kind, stored in files_for(settings).items():
        save(tmp_path / "calibration" / f"{kind}.yaml", stored)
    return config, settings


def test_a_typed_view_keeps_working_and_is_called_uncalibrated():
    config = Path("config/fake.yaml")
    known = calibrated(load_settings(config), config)
    assert known.map_std_m == 0.0
    assert "uncalibrated" in known.notes[0]
    assert known.view.to_plane(np.array([1000.0, 150.0])) == pytest.approx([0.0, 0.0])


def test_a_calibration_is_used_with_its_uncertainty(made):
    config, settings = made
    known = calibrated(settings, config, NOW)
    assert (known.latency_s, known.lag_s) == (0.02, 0.034)
    assert known.map_std_m == pytest.approx(3e-5 / CIRCLE_95)
    assert known.view.lens.k1 == -0.1
    assert "±0.030 mm" in known.notes[0]


def test_nothing_there_names_the_one_command(tmp_path):
    config = config_of(tmp_path, calibration=f"{{folder: {tmp_path / 'none'}}}")
    with pytest.raises(InputError, match=f"not calibrated yet.*`cell calibrate --config {config}`"):
        calibrated(load_settings(config), config, NOW)


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("time", {"made": NOW - timedelta(hours=30)}, "made 30 h ago, at most 24 h"),
        ("time", {"made": NOW + timedelta(hours=30)}, "made 30.0 h after the time that this"),
        ("cell", {"made": NOW - timedelta(days=100)}, "made 2400 h ago, at most 2160 h"),
        ("cell", {"error": {"map_95_m": 4e-4}}, "map_95_m = 0.0004 m, at most 0.00015"),
        ("cell", {"error": {"map_95_m": float("nan")}}, "map_95_m = nan m"),
        ("time", {"error": {"latency_95_s": 0.01, "lag_95_s": 0.0}}, "latency_95_s = 0.01 s"),
        ("camera", {"devices": {"camera": "genicam 7"}}, "made with camera genicam 7"),
        ("cell", {"devices": {"camera": "sim", "width_px": 640}}, "made with width_px 640"),
    ],
)
def test_one_that_does_not_hold_is_refused_with_its_remedy(made, kind, change, message):
    config, settings = made
    folder = settings.calibration.folder
    save(folder / f"{kind}.yaml", replace(files_for(settings)[kind], **change))
    with pytest.raises(InputError) as error:
        calibrated(settings, config, NOW)
    assert message in str(error.value)
    assert f"run `cell calibrate {kind} --config {config}`" in str(error.value)


def test_a_calibration_that_is_none_is_found_before_anything_moves(made):
    """`cell check` called settings right that the next `cell run` refused."""
    config, settings = made
    time = settings.calibration.folder / "time.yaml"
    whole = time.read_text()
    for wrong in ("", whole.replace("latency_s: 0.02", "latency_s: 0.5")):
        time.write_text(wrong)
        done = CliRunner().invoke(app, ["check", "--config", str(config)])
        assert done.exit_code == 2
        assert str(time) in done.stderr
    time.unlink()
    done = CliRunner().invoke(app, ["check", "--config", str(config)])
    assert done.exit_code == 0, done.stderr
    assert "time.yaml: No such file" in done.stderr
    assert "at best (the error of the camera's map, known after calibration" in done.stdout


def test_a_check_of_a_calibrated_cell_knows_the_error_of_its_map(made):
    config, settings = made
    for kind, stored in files_for(settings).items():
        now = replace(stored, made=datetime.now(UTC))
        save(settings.calibration.folder / f"{kind}.yaml", now)
    done = CliRunner().invoke(app, ["check", "--config", str(config)])
    assert "serves openings of ±0.17 mm at best; " in done.stdout  # ±0.16 mm by the tip alone


def test_one_missing_is_named(made):
    config, settings = made
    (settings.calibration.folder / "time.yaml").unlink()
    with pytest.raises(InputError, match=f"`cell calibrate time --config {config}`"):
        calibrated(settings, config, NOW)


def test_a_view_and_a_calibration_exclude_each_other(tmp_path):
    with pytest.raises(InputError, match=r"camera.view: is calibrated"):
        load_settings(config_of(tmp_path, calibration="{}", view=True))
    with pytest.raises(InputError, match=r"camera.view: is missing; add the section"):
        load_settings(config_of(tmp_path))


def test_a_check_refuses_a_file_as_folder_and_a_folder_as_file(tmp_path):
    calib = tmp_path / "calib"
    config = config_of(tmp_path, calibration=f"{{folder: {calib}}}")
    calib.touch()
    checked = CliRunner().invoke(app, ["check", "--config", str(config)])
    assert checked.exit_code == 2
    assert f"calibration.folder: {calib}: is a file; give a folder" in checked.stderr
    calib.unlink()
    (calib / "cell.yaml").mkdir(parents=True)
    checked = CliRunner().invoke(app, ["check", "--config", str(config)])
    assert checked.exit_code == 2
    assert f"{calib / 'cell.yaml'}: is a folder; remove it" in checked.stderr
