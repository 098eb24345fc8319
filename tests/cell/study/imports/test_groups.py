"""Several trials, or a trial and its gripper, in one file of arrays."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.study.data import Study
from cell.study.imports.read import read_capture
from cell.study.imports.trial_files import read_trials

from .corpus.others import line_protocol
from .corpus.swing import LENGTH_M, Swing, known_study
from .corpus.text import cells, lines
from .made import check_same, run, saved
from .test_corpus import study_from

PLACE_M = 1e-6


def _study(file: Path) -> tuple[Study, str]:
    return study_from([(file, None)], file.parent / "study", {}, {})


def _hand_log(s: Swing, start_s: float = -0.2, rate_hz: float = 500.0) -> dict[str, Any]:
    """A gripper on the markers' clock, at a rate of its own."""
    t_s = start_s + np.arange(round(2.0 * rate_hz)) / rate_hz
    x_m, y_m = (np.interp(t_s, s.t_s, v) for v in s.gripper_m.T)
    return {"t_ms": t_s * 1e3, "x_m": x_m, "y_m": y_m,
            "angle_rad": np.interp(t_s, s.t_s, s.angle_rad)}  # fmt: skip


@pytest.mark.parametrize("camera, robot", [("camera", "gripper"), ("cable", "hand")])
def test_groups_of_equal_structure_are_trials_with_their_grippers(
    tmp_path: Path, camera: str, robot: str
) -> None:
    import h5py

    truth = known_study()
    file = tmp_path / "session.h5"
    with h5py.File(file, "w") as store:
        for number, s in enumerate(truth, 1):
            store[f"trial_{number}/{camera}/t_ms"] = s.t_s * 1e3
            store[f"trial_{number}/{camera}/markers"] = s.markers_m
            store[f"trial_{number}/{camera}/markers"].attrs["unit"] = "m"
            for name, values in _hand_log(s).items():
                store[f"trial_{number}/{robot}/{name}"] = values
    study, _ = _study(file)
    assert [t.name for t in study.trials] == ["trial_1", "trial_2"]
    check_same(study, *truth, place_m=2e-4, angle_rad=1e-3)


def test_trials_in_one_file_have_grippers_in_files_of_their_own(tmp_path: Path) -> None:
    import h5py

    truth, file, hands = known_study(), tmp_path / "session.h5", list[Path]()
    with h5py.File(file, "w") as store:
        for number, s in enumerate(truth, 1):
            store[f"trial_{number}/t_ms"] = s.t_s * 1e3
            store[f"trial_{number}/markers"] = s.markers_m
            log = _hand_log(s)
            rows = cells(np.column_stack(list(log.values())), 9)
            hands.append(saved(tmp_path / f"robot_{number}.csv", lines([[*log], *rows])))
    trials = read_trials([file], hands, str)
    assert [t.name for t in trials] == ["trial_1", "trial_2"]
    assert [t.gripper_file for t in trials] == [str(hand) for hand in hands]
    with pytest.raises(ValueError, match="names 3 files for 2 trials"):
        read_trials([file], [*hands, hands[0]], str)


def test_what_attributes_state_of_the_cable_is_taken_and_not_contradicted(tmp_path: Path) -> None:
    import h5py

    file = tmp_path / "session.h5"
    with h5py.File(file, "w") as store:
        store.attrs["free_length_m"] = LENGTH_M
        store.attrs["line_density_kg_per_m"] = 0.0074
        store.attrs["diameter_m"] = 0.004
        for number, s in enumerate(known_study(), 1):
            store[f"swing{number}/time_s"] = s.t_s
            store[f"swing{number}/gripper_m"] = s.gripper_m
            store[f"swing{number}/angle_rad"] = s.angle_rad
            store[f"swing{number}/markers_m"] = s.markers_m
    run(file, "-o", tmp_path / "study")
    run(tmp_path / "study" / "import.yaml")
    said = run(file, "-o", tmp_path / "other", "--free-length", "0.15", code=2)
    assert "free_length_m 0.1" in said and "0.15" in said


def test_an_array_of_structures_is_a_trial_each_and_a_sentence_names_columns(
    tmp_path: Path,
) -> None:
    from scipy.io import savemat

    truth = known_study()
    kinds = [(n, object) for n in ("name", "t", "P", "grip", "unit", "note")]
    swings = np.empty(len(truth), dtype=kinds)
    for i, s in enumerate(truth):
        grip = np.column_stack([s.gripper_m * 1e3, np.rad2deg(s.angle_rad)])
        swings[i] = (s.name, s.t_s, s.markers_m * 1e3, grip, "mm",
                     "grip = [x y theta], theta in deg; y up")  # fmt: skip
    file = tmp_path / "swings.mat"
    savemat(file, {"swing": swings, "fs": 200.0})
    study, _ = _study(file)
    assert [t.name for t in study.trials] == ["down", "turning"]
    check_same(study, *truth, place_m=PLACE_M)


@pytest.mark.parametrize("word, above", [("name", True), ("name", False), ("label", True)])
def test_the_name_of_a_run_is_no_part_of_the_names_of_its_columns(
    tmp_path: Path, word: str, above: bool
) -> None:
    """Columns of the second run were sought by the name of the first."""
    from scipy.io import savemat

    truth, runs = known_study(), []
    for s in truth:
        camera = {"time": s.t_s} | {
            f"{a}_mm": s.markers_m[..., i] * 1e3 for i, a in enumerate("xy")
        }
        log = _hand_log(s)
        robot = {"time": log["t_ms"] * 1e-3, "theta_rad": log["angle_rad"]}
        robot["pos_mm"] = np.column_stack([log["x_m"], log["y_m"]]) * 1e3
        label = {word: s.name}
        below = {} if above else label
        runs.append({"cam": camera | below, "robot": robot | below} | label)
    file = tmp_path / "runs.mat"
    savemat(file, {"data": runs})
    study, _ = _study(file)
    assert [t.name for t in study.trials] == ["down", "turning"]
    check_same(study, *truth, place_m=2e-4, angle_rad=1e-3)
    columns = {c.name: c.unit for c in read_capture(tmp_path / "runs.mat#data.down.cam").columns}
    assert columns["x_mm 0"] == "mm" and not any("down" in name for name in columns)


@pytest.mark.parametrize("scale", ["json", "array", "none"])
def test_two_clocks_at_one_level_are_camera_and_robot(tmp_path: Path, scale: str) -> None:
    """The px of an array of pixels was taken as the axis of all its columns."""
    s = known_study()[1]
    log = _hand_log(s)
    meta = {"run": 3, "mm_per_px": 0.2, "origin_px": [400, 300]}
    stated = {"json": {"meta": json.dumps(meta)}, "array": {"mm_per_px": 0.2}, "none": {}}
    file = tmp_path / "run.npz"
    np.savez(
        file, t_cam=1.7e9 + s.t_s, pts_px=s.markers_m * [5e3, -5e3] + [400.0, 300.0],
        t_robot=1.7e9 + log["t_ms"] * 1e-3, tcp_xy_m=np.column_stack([log["x_m"], log["y_m"]]),
        tcp_pitch_rad=log["angle_rad"], **stated[scale],
    )  # fmt: skip
    study, _ = _study(file)
    (trial,) = study.trials
    moved = trial.markers.xy_m[:, ::-1] - trial.markers.xy_m[0, ::-1]
    limit = 5e-4 if scale == "none" else 1e-6  # then the unit is estimated
    np.testing.assert_allclose(moved, s.markers_m - s.markers_m[0], rtol=0.0, atol=limit)
    at = np.interp(s.t_s, trial.grip.t_s - trial.markers.t_s[0], trial.grip.angle_rad)
    np.testing.assert_allclose(at, s.angle_rad, atol=2e-3)
    notes = " ".join(read_capture(tmp_path / "run.npz#t_cam").notes)
    assert ("meta states run, origin_px, which is not read" in notes) == (scale == "json")
    assert ("0.2 mm a pixel" in notes) == (scale != "none")


def test_a_gripper_named_by_its_axes_keeps_its_times(tmp_path: Path) -> None:
    """They were named `tcp_x_m time_arm`, a coordinate."""
    s = known_study()[1]
    log = _hand_log(s)
    hand = {"tcp_x_m": log["x_m"], "tcp_y_m": log["y_m"], "tcp_pitch_rad": log["angle_rad"]}
    file = tmp_path / "run.npz"
    np.savez(file, time_cam=s.t_s, pts_m=s.markers_m, **hand, time_arm=log["t_ms"] * 1e-3)
    study, _ = _study(file)
    check_same(study, s, place_m=2e-4, angle_rad=1e-3)


def _two_rates(s: Swing) -> tuple[dict[str, Any], dict[str, Any]]:
    """Series of a gripper, mm and rad, from -0.2 s on at 500 Hz; and of markers at 200 Hz."""
    log = _hand_log(s)
    hand = {"x": log["x_m"] * 1e3, "y": log["y_m"] * 1e3, "phi": log["angle_rad"]}
    places = s.markers_m.transpose(1, 2, 0) * 1e3
    return hand, {f"m{k}_{a}": places[k, i] for k in range(5) for i, a in enumerate("xy")}


def _itx(s: Swing, folder: Path) -> Path:
    lines = ["IGOR", "X // two blocks"]
    hand, markers = _two_rates(s)
    for flags, start, step, waves in (
        ("/D", -0.2, 0.002, {f"clamp_{n}": v for n, v in hand.items()}),
        ("/D/O", 0.0, 0.005, markers),
    ):
        rows = np.column_stack(list(waves.values())).tolist()
        lines += [f"WAVES{flags}\t" + "\t".join(waves), "BEGIN"]
        lines += ["\t" + "\t".join(f"{v:.7f}" for v in row) for row in rows] + ["END"]
        lines += [
            f'X SetScale/P x {start},{step},"s", {n}; '
            f'SetScale {"d" if step < 0.004 else "y"} 0,0,"{"rad" if "phi" in n else "mm"}", {n}'
            for n in waves
        ]  # fmt: skip
    file = folder / "swing.itx"
    file.write_text("\r".join(lines) + "\r")
    return file


def _tdms(s: Swing, folder: Path) -> Path:
    from nptdms import ChannelObject, TdmsWriter

    hand, markers = _two_rates(s)
    began = np.datetime64("2026-11-30T12:00:00.000000")
    file = folder / "swing.tdms"
    channels = []
    for group, start_ms, offset_s, step_s, waves in (
        ("Robot", 0, 0.0, 0.002, hand),
        ("Vision", 150, 0.05, 0.005, markers),
    ):
        stated = {"wf_start_time": began + np.timedelta64(start_ms, "ms"),
                  "wf_start_offset": offset_s, "wf_increment": step_s}  # fmt: skip
        channels += [
            ChannelObject(group, n, v, stated | {"unit_string": "rad" if n == "phi" else "mm"})
            for n, v in waves.items()
        ]
    with TdmsWriter(file) as writer:
        writer.write_segment(channels)
    return file


@pytest.mark.parametrize("written", [_itx, _tdms])
def test_series_of_two_rates_have_the_times_that_their_scales_state(
    tmp_path: Path, written: Callable[[Swing, Path], Path]
) -> None:
    s = known_study()[1]
    study, said = _study(written(s, tmp_path))
    check_same(study, s, place_m=2e-4, angle_rad=1e-3)
    assert "unit" not in said and "time" not in said  # the file states the units


def test_a_matrix_and_a_time_wave_of_igor_are_read(tmp_path: Path) -> None:
    file = tmp_path / "w.itx"
    file.write_text(
        "IGOR\nWAVES/D t_ms\nBEGIN\n0\n5\n10\nEND\nWAVES/N=(3,2) tip\nBEGIN\n1 2\n3 NaN\n5 6\n"
        'END\nX SetScale d 0,0,"mm", tip\nWAVES/T note\nBEGIN\n"a b"\nEND\n'
    )
    capture = read_capture(file)
    assert [(c.name, c.unit) for c in capture.columns] == [
        ("t_ms", ""), ("tip x", "mm"), ("tip y", "mm")
    ]  # fmt: skip
    np.testing.assert_array_equal(capture.values, [[0, 1, 2], [5, 3, np.nan], [10, 5, 6]])
    for text, said in (("BEGIN\n1 x\nEND", "line 4: is no row"), ("BEGIN\n1 2", "no END")):
        file.write_text(f"IGOR\nWAVES a_x, a_y\n{text}\n")
        with pytest.raises(InputError, match=said):
            read_capture(file)


def test_places_that_a_faster_program_holds_are_measured_once(tmp_path: Path) -> None:
    from scipy.io import savemat

    s = known_study()[1]
    held = np.repeat(s.markers_m.reshape(len(s.t_s), -1), 5, axis=0)
    t_s = np.arange(len(held)) / 1000.0
    hand = np.column_stack([*(np.interp(t_s, s.t_s, v) for v in (*s.gripper_m.T, s.angle_rad))])
    names = " ".join(f"x{k} z{k}" for k in range(1, 6))
    file = tmp_path / "simout.mat"
    savemat(file, {
        "cable_xz": {"time": t_s, "signals": {"values": held, "label": f"{names} [m]"}},
        "hand": {"time": t_s, "signals": {"values": hand, "label": "x z pitch [m m rad]"}},
    })  # fmt: skip
    study, _ = _study(file)
    check_same(study, s, place_m=PLACE_M)


def test_groups_that_do_not_pair_are_refused_and_can_be_named(tmp_path: Path) -> None:
    import h5py

    s = known_study()[0]
    file = tmp_path / "session.h5"
    with h5py.File(file, "w") as store:
        for name, count in (("left", 5), ("right", 4)):
            store[f"{name}/t_s"] = s.t_s
            store[f"{name}/gripper_m"] = s.gripper_m
            for k in range(count):
                store[f"{name}/m{k}_m"] = s.markers_m[:, k]
    with pytest.raises(InputError, match=r"session\.h5#left"):
        _study(file)
    assert len(read_capture(tmp_path / "session.h5#left").columns) == 13
    with pytest.raises(InputError, match="it has left, right"):
        read_capture(tmp_path / "session.h5#middle")


def test_runs_of_line_protocol_are_trials(tmp_path: Path) -> None:
    truth = known_study()
    study, _ = _study(line_protocol(truth[0], tmp_path, runs=truth))
    assert [t.name for t in study.trials] == ["down", "turning"]
    check_same(study, *truth, place_m=PLACE_M)


def test_an_unknown_ending_of_no_table_asks_for_one(tmp_path: Path) -> None:
    words = tmp_path / "notes.xyz"
    words.write_text("nothing that is a table\nof numbers\n")
    with pytest.raises(InputError, match="export a CSV"):
        read_capture(words)
    bytes_ = tmp_path / "film.xyz"
    bytes_.write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="no kind of file"):
        read_capture(bytes_)


@pytest.mark.parametrize(("ending", "export"), [
    (".mf4", r"MDF\('.*run.mf4'\).export"), (".bag", "rosbags-convert --src .*run.bag"),
    (".blf", "dbc"), (".pkl", "numpy.savez"), (".zip", "unpack"),
])  # fmt: skip
def test_a_known_kind_that_is_not_read_names_its_export(
    ending: str, export: str, tmp_path: Path
) -> None:
    file, hand = tmp_path / f"run{ending}", tmp_path / "hand.csv"
    file.write_bytes(b"\x00\x01\x02")
    hand.write_text("t,x,y\n0,1,2\n1,2,3\n2,4,5\n")
    with pytest.raises(InputError, match=export):
        read_capture(file)
    with pytest.raises(InputError, match=export):  # before their number is compared
        read_trials([file], [hand, hand, hand], str)


@pytest.mark.parametrize("name", ["bag_0.db3", "bag_0.sqlite3"])
def test_a_rosbag2_is_told_by_its_tables_and_its_description(name: str, tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / name)) as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT)")
        database.execute("CREATE TABLE messages(id INTEGER, timestamp INTEGER, data BLOB)")
        database.commit()
    description = saved(tmp_path / "metadata.yaml", "rosbag2_bagfile_information:\n  version: 6\n")
    for file in (tmp_path / name, description):
        with pytest.raises(InputError, match=f"rosbags-convert --src {tmp_path} --dst OUT"):
            read_trials([file], [], str)
    told = run(tmp_path, "-o", tmp_path / "s", "--free-length", "0.1", code=2)
    assert "rosbags-convert --src" in told
