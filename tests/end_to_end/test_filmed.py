"""A film of one's own becomes a recording, which is replayed and given to the lab as any other."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from cell.records.recording import form
from cell.records.recording.reading import read_recording
from cell.settings import Settings
from cell.study.folder import read_study
from cell.study.table import table_text
from cell.wiring.build import build_cell
from drivers.files import write_frames
from drivers.interfaces import Frame

from .conftest import run

COLUMNS = ("t_s", "x_m", "y_m", "angle_rad")


@pytest.fixture(scope="module")
def own(recorded_config: Path, tmp_path_factory: pytest.TempPathFactory):
    """Pictures and poses of the hold of a simulated cycle, as another laboratory may have them."""
    from cell.settings import load_settings

    settings: Settings = load_settings(recorded_config)
    folder = tmp_path_factory.mktemp("own")
    cell = build_cell(settings, folder / "runs", seed=3, cycles=1)
    result = cell.run_cycle(1)
    cell.close()
    recording = read_recording(Path(result.folder))
    filming = recording.last(form.FILMING)
    frames = [f for f in recording.frames() if f.t_s < filming["end_s"]][: filming["frame_count"]]
    begin_s = frames[0].t_s
    write_frames(folder / "film", [Frame(f.index, f.t_s - begin_s, f.image) for f in frames])
    answers = recording.trajectories(form.ANSWER)
    hand = next(
        h
        for said, h in answers
        if said["start_s"] == filming["begin_s"] and h.t_s[-1] >= frames[-1].t_s
    )
    columns = np.column_stack([hand.t_s - begin_s, hand.x_m, hand.y_m, hand.angle_rad])
    (folder / "poses.csv").write_text(table_text(COLUMNS, columns))
    size = frames[0].image.shape[::-1]
    codec = cv2.VideoWriter_fourcc(*"FFV1")
    rate_hz = 1.0 / float(np.median(np.diff([f.t_s for f in frames])))
    video = cv2.VideoWriter(str(folder / "film.avi"), codec, rate_hz, size, isColor=True)
    for frame in frames:
        video.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    video.release()
    return folder, result, recorded_config


def imported(own, film: str, *words: object):
    folder, _, config = own
    out = folder / f"{film}.mcap"
    done = run(
        "replay",
        folder / film,
        "--import",
        "--poses",
        folder / "poses.csv",
        "--config",
        config,
        "-o",
        out,
        "--json",
        *words,
    )
    return done, out


@pytest.fixture(scope="module")
def of_pictures(own):
    """What the import of the pictures said, and its recording."""
    return imported(own, "film")


def test_pictures_become_a_recording_that_decides_as_the_cell_did(own, of_pictures):
    done, out = of_pictures
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)["result"]
    _, then, _ = own
    assert result["outcome"] == "measured"
    # the cell identified once more after the insertion; from the hold alone it is nearly the same
    for name, value in then.parameters.items():
        assert result["parameters"][name] == pytest.approx(value, rel=0.05, abs=1e-9)
    assert result["offset_m"] == pytest.approx(then.offset_m, abs=2.1e-3)
    recording = read_recording(out)
    assert recording.complete
    assert recording.count(form.IMAGE) == recording.count(form.SEEN) > 54
    assert recording.count(form.MEASURED) > 300
    again = run("replay", out, "--json")
    assert again.returncode == 0, again.stdout
    assert json.loads(again.stdout)["identical"]
    shown = run("identify", out)
    assert shown.returncode == 0, shown.stderr


def test_a_video_is_the_same_film(own, of_pictures):
    done, out = imported(own, "film.avi")
    assert done.returncode == 0, done.stderr
    frames = [f.image for f in read_recording(out).frames()]
    pictures = [f.image for f in read_recording(of_pictures[1]).frames()]
    assert len(frames) == len(pictures)
    assert all(np.abs(a.astype(int) - b).max() <= 1 for a, b in zip(frames, pictures, strict=True))


def test_a_video_and_a_recording_become_studies_at_once(own, tmp_path):
    folder, _, config = own
    film = ["--hand", folder / "poses.csv", "--config", config]
    done = run("import", folder / "film.avi", *film, "-o", tmp_path / "of_film", "--json")
    assert done.returncode == 0, done.stderr
    seen = read_study(tmp_path / "of_film")
    assert len(seen.trials[0].markers.t_s) > 54
    recording = tmp_path / "of_film" / "film.mcap"
    again = run("import", recording, "-o", tmp_path / "of_recording")
    assert again.returncode == 0, again.stderr
    same = read_study(tmp_path / "of_recording").trials[0]
    np.testing.assert_array_equal(same.markers.xy_m, seen.trials[0].markers.xy_m)
    without = run("import", folder / "film.avi", "-o", tmp_path / "no")
    assert without.returncode == 2
    assert "--config and --hand" in without.stderr


def test_a_hand_that_ends_elsewhere_is_identified_without_a_choice(own, tmp_path):
    """Moved as a whole, picture and hand: no insertion begins there."""
    folder, then, config = own
    text = config.read_text()
    origin = next(line for line in text.splitlines() if "origin_row_px" in line)
    settings = tmp_path / "higher.yaml"
    settings.write_text(text)
    table = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    table[:, 2] += 0.01
    row = float(origin.split("origin_row_px:")[1].strip(" }"))
    per_pixel = float(origin.split("metres_per_pixel:")[1].split(",")[0])
    settings.write_text(
        text.replace(
            origin,
            origin.replace(f"{origin.split('origin_row_px:')[1]}", f" {row + 0.01 / per_pixel}}}"),
        )
    )
    (tmp_path / "poses.csv").write_text(table_text(COLUMNS, table))
    out = tmp_path / "film.mcap"
    done = run(
        "replay",
        folder / "film",
        "--import",
        "--poses",
        tmp_path / "poses.csv",
        "--config",
        settings,
        "-o",
        out,
        "--json",
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)["result"]
    assert result["offset_m"] is None
    for name, value in then.parameters.items():
        assert result["parameters"][name] == pytest.approx(value, rel=0.05, abs=1e-9)
    assert json.loads(run("replay", out, "--json").stdout)["identical"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["gone", "--poses", "poses.csv"], "is missing"),
        (["film", "--poses", "gone.csv"], "gone.csv"),
        (["poses.csv", "--poses", "poses.csv"], "is no video"),
        (["film", "--poses", "poses.csv", "--first-frame", "7"], "--first-frame"),
        (["film"], "needs --poses and --config"),
        (["film", "--poses", "still.csv"], "does not swing"),
        (["film", "--poses", "short.csv"], "log the gripper for as long as is filmed"),
    ],
)
def test_what_is_wrong_with_a_film_is_named(own, tmp_path, words, said):
    folder, _, config = own
    table = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    (folder / "short.csv").write_text(table_text(COLUMNS, table[:100]))
    table[:, 1:] = table[0, 1:]
    (folder / "still.csv").write_text(table_text(COLUMNS, table))
    out = tmp_path / "out.mcap"
    given = [w if w.startswith("-") or w == "7" else str(folder / w) for w in words]
    done = run("replay", *given, "--import", "--config", config, "-o", out)
    assert done.returncode == 2
    assert said in done.stderr
    assert not out.exists()
    assert "Traceback" not in done.stderr


def test_options_of_an_import_are_of_no_replay(own):
    assert run("replay", own[0] / "film", "--poses", own[0] / "poses.csv").returncode == 2
