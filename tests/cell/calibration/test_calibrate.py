"""A simulated cell with a tilted, distorted camera and late stamps: refused, calibrated, right."""

from __future__ import annotations

import errno
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calib.camera import picture_grid
from calib.errors import MisfitError
from calib.lens import Lens
from calib.plane import PlaneView
from calib.store import load
from cell.calibration.raw import read_cell
from cell.cli import app
from cell.settings import load_settings
from cell.settings.calibrated import calibrated
from cell.wiring.build import cell_task
from drivers.interfaces import DeviceLostError
from drivers.sim.camera import SimCamera
from drivers.sim.pinhole import Pinhole

VIEW = "  view: {metres_per_pixel: 0.0002, origin_column_px: 1000, origin_row_px: 150}\n"
TILT_RAD = np.radians(12.0)
ASKEW_RAD, LONGER_M = 0.02, 0.0012
CAMERA = (
    "{metres_per_pixel: 0.0002, origin_column_px: %g, origin_row_px: 150, "
    f"tilt_rad: {TILT_RAD:.6f}, roll_rad: 0.02, k1: -0.2, k2: 0.05, stamps_late_s: %g}}"
)


def settings_file(folder: Path, name="cell.yaml", column=1000.0, late_s=0.02, lag_s=0.034) -> Path:
    text = Path("config/fake.yaml").read_text().replace(VIEW, "")
    world = f"\nworld:\n  arm_lag_s: {lag_s}\n  camera: {CAMERA % (column, late_s)}\n"
    text = text.replace("\nworld:", f"\ncalibration: {{folder: {folder / 'calib'}}}\n{world}", 1)
    held = f"{{grip_angle: {{angle_rad: {ASKEW_RAD}}}, grip_slip: {{length_m: {LONGER_M}}}}}"
    text = re.sub(r"effects: \{\}.*", f"effects: {held}", text)
    path = folder / name
    path.write_text(f"{text}\nrecording: null\n")  # nobody looks at films of these cycles
    return path


def called(*words: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(w) for w in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cell")
    config = settings_file(folder)
    code, _, refused = called("run", "--config", config, "--runs", folder / "runs")
    assert code == 2
    assert f"not calibrated yet: {folder / 'calib'} has nothing" in refused
    assert not (folder / "runs").exists()
    code, out, _ = called("calibrate", "--config", config, "--json")
    assert code == 0
    (folder / "summary.json").write_text(out)
    return folder


def test_the_map_is_right_within_its_bound(folder):
    known = calibrated(load_settings(folder / "cell.yaml"), folder / "cell.yaml")
    eye = Pinhole.standing(
        metres_per_pixel=2e-4, origin_px=(1000.0, 150.0), size_px=(1280, 1024), focal_px=2600.0,
        tilt_rad=TILT_RAD, roll_rad=0.02, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0),
    )  # fmt: skip
    lens = Lens(eye.focal_px, eye.focal_px, *eye.centre_px, *eye.distortion)
    grid = picture_grid((1280, 1024))
    off = known.view.to_plane(grid) - PlaneView.from_pose(lens, eye.X_CP).to_plane(grid)
    off = np.linalg.norm(off, axis=-1)
    assert np.sqrt(np.mean(off**2)) < 5e-5
    assert off.max() < 1.5e-4
    stored = load(folder / "calib" / "cell.yaml", "cell")
    assert off.max() < 2.0 * stored.error["map_95_m"]
    assert stored.error["held_out_rms_m"] < 2e-5
    assert 1e-6 < stored.error["classic_rms_m"] < stored.error["classic_max_m"] < 6e-4
    assert stored.error["bend_m"] < 1e-5


def test_delays_roll_and_scale_are_right(folder):
    time = load(folder / "calib" / "time.yaml", "time")
    assert time.number("latency_s") == pytest.approx(0.02, abs=3e-4)
    assert time.number("lag_s") == pytest.approx(0.034, abs=1e-3)
    cell = load(folder / "calib" / "cell.yaml", "cell")
    assert cell.number("roll_rad") == pytest.approx(0.02, abs=np.radians(0.03))
    assert cell.number("marks_scale") == pytest.approx(1.0, abs=1e-3)


def test_a_grip_is_right_and_the_cell_works_with_it(folder):
    grip = load(folder / "calib" / "grip.yaml", "grip")
    assert grip.number("angle_rad") == pytest.approx(ASKEW_RAD, abs=0.002)
    assert grip.number("length_m") == pytest.approx(0.1 + LONGER_M, abs=1e-4)
    assert np.allclose(grip.array("point_m", (2,)), 0.0, atol=4e-5)
    settings = load_settings(folder / "cell.yaml")
    known = calibrated(settings, folder / "cell.yaml")
    task = cell_task(settings, known)
    assert task.cable.free_length_m == task.vision.free_length_m == grip.number("length_m")
    # a gripper that stands level holds the cable askew: to the cable's eye the marks are turned
    # back
    (x, y), (level_x, level_y) = task.vision.marks.centres_m[2], (0.032, 0.009)
    turn = np.arctan2(y, x) - np.arctan2(level_y, level_x)
    assert turn == pytest.approx(-ASKEW_RAD, abs=0.003)
    assert any("clamp angle ±" in note for note in known.notes)


def test_without_a_grip_the_cell_says_so(folder, tmp_path):
    config = settings_file(tmp_path)
    shutil.copytree(folder / "calib", tmp_path / "calib", dirs_exist_ok=True)
    (tmp_path / "calib" / "grip.yaml").unlink()
    settings = load_settings(config)
    known = calibrated(settings, config)
    assert known.grip is None
    assert "uncalibrated: gripping point, clamp angle and free length are as typed" in known.notes
    assert cell_task(settings, known).cable.free_length_m == settings.cable.free_length_m


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"late_s": 0.023}, r"camera: timestamps late by \+3\.0\d ms since it was calibrated"),
        ({"lag_s": 0.037}, r"arm: lag changed by \+[23]\.\d\d ms since it was calibrated"),
    ],
)
def test_a_run_refuses_delays_that_changed_since_from_its_first_motion(
    folder, tmp_path, change, words
):
    config = settings_file(folder, "later.yaml", **change)
    code, out, _ = called("run", "--config", config, "--runs", tmp_path, "--json")
    result = json.loads(out)
    assert (code, result["outcome"], result["fault"]["step"]) == (1, "failed", "check_clocks")
    said = f"{result['fault']['device']}: {result['fault']['cause']}"
    assert re.search(words, said), said
    assert result["fault"]["remedy"] == f"run `cell calibrate time --config {config}`"


def test_a_run_with_delays_as_calibrated_records_them(folder, tmp_path):
    code, out, _ = called("run", "--config", folder / "cell.yaml", "--runs", tmp_path, "--json")
    late, lag = json.loads(out)["checks"]
    assert code == 0
    assert (late["what"], lag["what"]) == ("camera: timestamps late by", "arm: lag changed by")
    assert max(abs(late["found"]), abs(lag["found"])) < 2e-4


def test_reports_and_summary_are_there(folder):
    summary = json.loads((folder / "summary.json").read_text())
    assert set(summary) == {"camera", "cell", "time", "grip"}
    for kind, found in summary.items():
        page = Path(found["report"]).read_text()
        assert page.startswith("<!doctype html>")
        assert ("<img" if kind == "grip" else "<svg") in page
        assert Path(found["file"]) == folder / "calib" / f"{kind}.yaml"


def test_recorded_folders_give_the_same_again(folder):
    for kind in ("camera", "cell", "time", "grip"):
        (recorded,) = (folder / "calib" / "recorded").glob(f"{kind}-*")
        before = load(folder / "calib" / f"{kind}.yaml", kind)
        code, _, _ = called("calibrate", kind, "--config", folder / "cell.yaml", "--from", recorded)
        assert code == 0
        after = load(folder / "calib" / f"{kind}.yaml", kind)
        for name, value in before.result.items():
            assert np.allclose(value, after.result[name], rtol=1e-6, atol=1e-9)


def test_on_a_full_disk_a_calibration_is_said_and_kept_elsewhere(folder, tmp_path, monkeypatch):
    def full(path, *_):
        if path.parent == folder / "calib":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        path.write_text("kept")

    monkeypatch.setattr("cell.calibration.work.save", full)
    monkeypatch.setattr("cell.calibration.work.write_atomic", full)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (recorded,) = (folder / "calib" / "recorded").glob("time-*")
    code, out, told = called(
        "calibrate", "time", "--config", folder / "cell.yaml", "--from", recorded
    )
    assert (code, "latency" in out) == (1, True)
    for name in ("time.html", "time.yaml"):
        (copy,) = tmp_path.glob(f"*/{name}")
        assert f"{name}: cannot be written: No space left on device; it is kept as {copy}" in told


def of_ones_own(folder, own, change=lambda text: text):
    """Recorded poses as pictures of one's own: other names, a table from a spreadsheet."""
    (recorded,) = (folder / "calib" / "recorded").glob("cell-*")
    shutil.copytree(recorded, own)
    for picture in own.glob("pose_*.png"):
        picture.rename(own / picture.name.replace("pose_", "DSC "))
    table = own / "poses.csv"
    table.write_text(change(table.read_text().replace("pose_", "DSC ")))
    return called("calibrate", "cell", "--config", folder / "cell.yaml", "--from", own, "--json")


def by_role_last(text):
    rows = [line.split(",") for line in text.splitlines()]
    return "\ufeff" + "\r\n".join(", ".join([r[0], *r[2:], r[1]]) for r in rows) + "\r\n\r\n"


def test_pictures_of_ones_own_give_the_same(folder, tmp_path):
    before = load(folder / "calib" / "cell.yaml", "cell").result
    code, out, _ = of_ones_own(folder, tmp_path / "own", by_role_last)
    assert code == 0
    found = json.loads(out)["cell"]
    for name, value in before.items():
        assert np.allclose(value, found["result"][name], rtol=1e-6, atol=1e-9)


def test_a_map_that_nothing_judges_says_so(folder, tmp_path):
    code, out, _ = of_ones_own(
        folder, tmp_path / "own", lambda text: text.replace("held_out", "fit")
    )
    assert (code, json.loads(out)["cell"]["error"]["held_out_rms_m"]) == (0, None)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.split("\n", 1)[1], "poses.csv:1: must begin with the line picture,role,x_m"),
        (lambda t: re.sub(r"(fit),-?[0-9.e-]+", r"\1,nan", t, count=1), "poses.csv:2: has a num"),
        (lambda t: re.sub(r"(fit),-?[0-9.]+", r"\1,-48.5", t, count=1), "give metres, not millim"),
        (lambda t: re.sub(r"-?[0-9.e-]+\n", "29.4\n", t, count=1), "give radians, not degrees"),
        (lambda t: t.replace("DSC 01", "DSC 99"), "DSC 99.png:1: is missing or no picture"),
    ],
    ids=["no header", "nan", "mm", "degrees", "missing"],
)
def test_a_wrong_table_of_poses_is_named_with_its_line(folder, tmp_path, change, words, capfd):
    code, _, told = of_ones_own(folder, tmp_path / "own", change)
    assert (code, words in told) == (2, True), told
    assert "imread" not in capfd.readouterr().err


def test_pictures_of_another_size_are_named(folder, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((480, 640), np.uint8))
    words = ["camera", "--config", folder / "cell.yaml", "--from", tmp_path]
    code, _, told = called("calibrate", *words)
    assert code == 2
    assert "a.png:1: has 640 × 480 pixels, the camera of " in told


def test_a_wrong_folder_is_named(folder, tmp_path):
    code, _, refused = called(
        "calibrate", "camera", "--config", folder / "cell.yaml", "--from", tmp_path
    )
    assert (code, "has no pictures" in refused) == (2, True)


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({}, 0, "good: "),
        ({"column": 1004.0}, 1, "moved by 0.7"),
        ({"late_s": 0.023}, 1, "recalibrate time: the camera's latency changed by +3.0"),
    ],
)
def test_check_says_what_changed(folder, change, code, words):
    config = settings_file(folder, "today.yaml", **change)
    found = called("calibrate", "check", "--config", config)
    assert found[0] == code
    assert words in found[1]
    assert ("run `cell calibrate" in found[1]) == bool(code)


def test_the_board_comes_as_a_pdf(tmp_path):
    assert called("calibrate", "board", "-o", tmp_path / "b.pdf", "--square-mm", 15)[0] == 0
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF-1.4")
    code, _, refused = called("calibrate", "board", "--columns", 40, "--rows", 40)
    assert (code, "take a larger dictionary" in refused) == (2, True)


def test_a_device_that_fails_breaks_it_off_with_its_remedy(tmp_path, monkeypatch):
    def lost(camera: SimCamera, frame_count: int) -> None:
        raise DeviceLostError("camera", "fell silent", "look at its cable")

    monkeypatch.setattr(SimCamera, "start", lost)
    code, out, said = called("calibrate", "camera", "--config", settings_file(tmp_path))
    assert (code, out) == (2, "")
    assert said.splitlines()[-1] == "camera: fell silent; look at its cable"
    assert not (tmp_path / "calib" / "camera.yaml").exists()


@pytest.mark.parametrize("part", [(), ("cell",)])
def test_where_results_cannot_be_written_nothing_moves(tmp_path, monkeypatch, part):
    def moved(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("cell.calibration.work.staged_devices", moved)
    config, calib = settings_file(tmp_path), tmp_path / "calib"
    calib.touch()
    code, _, refused = called("calibrate", *part, "--config", config)
    assert (code, "is no folder that may be changed" in refused) == (2, True)
    calib.unlink()
    (calib / "cell.yaml").mkdir(parents=True)
    code, _, refused = called("calibrate", *part, "--config", config)
    assert code == 2
    assert f"calibration.folder: {calib / 'cell.yaml'}: is a folder" in refused


def test_a_mistake_of_the_program_is_no_wrong_input(folder, monkeypatch):
    """It was told as one, without a traceback."""

    def broken(*_: object) -> None:
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr("cell.calibration.conclude.camera_from", broken)
    (recorded,) = (folder / "calib" / "recorded").glob("camera-*")
    with pytest.raises(ValueError, match="operands"):
        called("calibrate", "camera", "--config", folder / "cell.yaml", "--from", recorded)


def test_an_impossible_board_is_named_with_its_file(tmp_path):
    config = settings_file(tmp_path)
    config.write_text(config.read_text().replace("/calib}", "/calib, dictionary: 9X9}"))
    code, _, refused = called("calibrate", "camera", "--config", config)
    assert code == 2
    assert f"{config}:" in refused
    assert "must be one of 4X4_50" in refused


def test_a_grip_known_too_poorly_is_left_out_and_the_cell_runs_without_it(folder, tmp_path):
    """An emulated cell, whose gripper cannot let the cable hang, was refused because of it."""
    config = settings_file(tmp_path)
    shutil.copytree(folder / "calib", tmp_path / "calib", dirs_exist_ok=True)
    (tmp_path / "calib" / "grip.yaml").unlink()
    config.write_text(config.read_text().replace("/calib}", "/calib, max_clamp_error_rad: 1e-6}"))
    (recorded,) = (folder / "calib" / "recorded").glob("grip-*")
    code, out, said = called("calibrate", "grip", "--config", config, "--from", recorded)
    assert (code, out) == (1, "")
    assert "at most 1e-06 allowed; light the cable better, let limits.angle_rad reach" in said
    assert "grip is left out: what is typed holds" in said
    assert calibrated(load_settings(config), config).grip is None


def test_poses_of_which_no_map_follows_are_kept_for_another_try(folder, tmp_path, monkeypatch):
    config = settings_file(tmp_path)
    shutil.copytree(folder / "calib", tmp_path / "calib", dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "calib" / "recorded")

    def refused(*_: object) -> None:
        raise MisfitError("the marks are beside where they must be", "check the plate")

    monkeypatch.setattr("cell.calibration.conclude.cell_from", refused)
    code, _, said = called("calibrate", "cell", "--config", config)
    (kept,) = (tmp_path / "calib" / "recorded").glob("cell-*")
    assert code == 2
    assert f"9 poses are kept in {kept}, for --from" in said
    monkeypatch.undo()
    assert len(read_cell(kept).poses) == 9
    assert called("calibrate", "cell", "--config", config, "--from", kept)[0] in (0, 1)


def test_a_hand_that_does_not_rest_is_told(folder, tmp_path):
    config = settings_file(tmp_path)
    shutil.copytree(folder / "calib", tmp_path / "calib", dirs_exist_ok=True)
    config.write_text(config.read_text().replace("kind: sim\n", "kind: sim\n  noise_m: 1e-4\n", 1))
    code, _, refused = called("calibrate", "cell", "--config", config)
    assert code == 2
    assert re.search(r"the gripper moved by 0\.\d\d mm while pictures were taken; let", refused)


def test_a_poor_calibration_says_what_would_make_it_better(folder, tmp_path):
    config = settings_file(tmp_path)
    shutil.copytree(folder / "calib", tmp_path / "calib", dirs_exist_ok=True)
    config.write_text(config.read_text().replace("/calib}", "/calib, max_error_m: 1e-6}"))
    (recorded,) = (folder / "calib" / "recorded").glob("cell-*")
    code, _, said = called("calibrate", "cell", "--config", config, "--from", recorded)
    assert code == 1
    assert "at most 1e-06 allowed; widen `limits`" in said
