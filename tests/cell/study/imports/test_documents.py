"""Structured documents, streams within one file, and the time stamps of databases and PLCs."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from openpyxl import Workbook
from scipy.spatial.transform import Rotation

from cell.cli.imports import _is_mapping
from cell.files.input_error import InputError
from cell.study.folder import read_study
from cell.study.imports.capture import Capture, CapturedColumn, ImportFindings, number
from cell.study.imports.choosing import choose
from cell.study.imports.contents import contents
from cell.study.imports.gripper_proposal import gripper_file
from cell.study.imports.read import read_capture
from cell.study.imports.scales import time_section
from cell.study.imports.trial_files import read_trials
from cell.study.imports.trials import Files
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.swing import Swing
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import CABLE, check_same, digits, imported, made, run, text

_EPOCH_S = 1_715_677_953.0


def _trials(file: Path, hand: Path | None = None) -> list[Files]:
    return read_trials([file], [hand], lambda path: path.name)


def _mapping(folder: Path) -> str:
    """The proposed mapping with its findings, in one line."""
    lines = (folder / "study" / "import.yaml").read_text().splitlines()
    return " ".join(" ".join(line.lstrip("# ") for line in lines).split())


# --- XML ------------------------------------------------------------------------------------------


def _telegram(k: int) -> str:
    poses = [f'<{n} X="{8 + k + d}.5" Y="1.0" Z="{2 * k}"/>' for n, d in (("RSol", 3), ("RIst", 0))]
    return f'<Rob Type="KUKA">{"".join(poses)}<IPOC>{2841190236 + 4 * k}</IPOC></Rob>'


def test_a_log_of_telegrams_has_columns_of_attributes_and_texts(tmp_path: Path) -> None:
    lines = [_telegram(k) for k in range(30)]
    log = read_capture(saved(tmp_path / "rsi.log", "\r\n".join([*lines, lines[0][:40]])))
    assert np.array_equal(log.column("RIst X"), 8.5 + np.arange(30))
    assert log.lines[-1] == 30  # the torn line behind it is left out
    assert time_section(log, contents(log), None)[0].seconds_per_unit == 1e-3
    hand = gripper_file(log).point
    assert hand is not None and hand.columns[0] == "RIst X"  # not what was commanded


def test_xml_of_repeated_elements_is_a_row_of_each(tmp_path: Path) -> None:
    rows = "".join(f"<row><t>{k / 100}</t><tip x='{k}' y='2'/></row>" for k in range(9))
    read = read_capture(saved(tmp_path / "a.xml", f"<?xml version='1.0'?>\n<a n='1'>{rows}</a>"))
    assert read.names == ("t", "tip x", "tip y") and len(read.values) == 9


def test_xml_that_defines_entities_is_refused(tmp_path: Path) -> None:
    bomb = '<!DOCTYPE a [<!ENTITY b "bb">]><a>&b;</a>'
    with pytest.raises(InputError, match="entities"):
        read_capture(saved(tmp_path / "a.xml", bomb))
    with pytest.raises(InputError, match="is no XML"):
        read_capture(saved(tmp_path / "b.xml", "<a><b></a>"))


# --- YAML of OpenCV -------------------------------------------------------------------------------


def _matrix(name: str, rows: int, values: np.ndarray) -> list[str]:
    numbers = ", ".join(".Nan" if v != v else f"{v:.9e}" for v in values.ravel())
    head = [f"   {name}: !!opencv-matrix", f"      rows: {rows}"]
    return [
        *head,
        f"      cols: {values.size // rows}",
        "      dt: d",
        f"      data: [ {numbers} ]",
    ]


def test_opencv_yaml_is_measurements_with_the_jaws_angle(tmp_path: Path) -> None:
    m, lines = made(), ["%YAML:1.0", "---", "fps: 200."]
    angle = 180.0 - np.degrees(m.angle_rad)
    for k, t in enumerate(m.t_s):
        points = m.markers_m[k] * [1.0, -1.0]
        points[1] += np.nan if k == 200 else 0.0
        jaw = np.array([*m.gripper_m[k] * [1.0, -1.0] * 1e3, (angle[k] + 180.0) % 360.0 - 180.0])
        lines += [f"frame_{k:04d}:", f"   time: {t:.6f}"]
        lines += _matrix("points", len(NAMES), points * 1e3) + _matrix("jaw", 1, jaw)
    file = saved(tmp_path / "shot.yml", "\n".join(lines))
    said = run(file, "-o", tmp_path / "s", *CABLE)
    assert "jaw x and jaw y are taken as its place" in said and "column 'jaw z' in deg" in said
    seen = read_capture(file).at(["points 1 x", "points 1 y"])
    assert np.isnan(seen[200]).all() and np.isfinite(seen[201]).all()


def test_a_mapping_is_told_by_its_entries(tmp_path: Path) -> None:
    mapping = saved(tmp_path / "import.yaml", "# remark\nformat: cable-import/1\n")
    assert _is_mapping(mapping)
    assert _is_mapping(saved(tmp_path / "bare.yaml", "name: a\ntrials: []\n"))
    assert _is_mapping(tmp_path / "missing.yaml")
    assert not _is_mapping(saved(tmp_path / "shot.yml", "%YAML:1.0\n---\nfps: 100.\n"))
    assert not _is_mapping(saved(tmp_path / "trial.csv", "format: a\n"))


# --- transforms of ROS ----------------------------------------------------------------------------


def _transform(t_s: float, parent: str, child: str, pose: tuple[np.ndarray, Rotation]) -> list[str]:
    second, turn = int(t_s), pose[1].as_quat()
    return [
        "- header:", "    stamp:", f"      sec: {second}",
        f"      nanosec: {round((t_s - second) * 1e9)}", f"    frame_id: {parent}",
        f"  child_frame_id: {child}", "  transform:", "    translation:",
        *(f"      {a}: {v!r}" for a, v in zip("xyz", pose[0].tolist(), strict=True)),
        "    rotation:", *(f"      {a}: {v!r}" for a, v in zip("xyzw", turn.tolist(), strict=True)),
    ]  # fmt: skip


def _echoes(m: Swing, folder: Path, name: str) -> tuple[Path, Path]:
    """What `ros2 topic echo` prints of /tf and /tf_static: tags in the camera's frame, the gripper
    a constant way behind the robot's last frame."""
    camera = np.array([0.4, -0.6, 0.3]), Rotation.from_euler("xyz", [0.3, -1.2, 0.8])
    tool = np.array([0.012, 0.0, 0.14]), Rotation.from_euler("y", 0.5)
    documents, none = [], Rotation.identity()
    for k, t in enumerate(m.t_s):
        turn = Rotation.from_rotvec((np.pi + m.angle_rad[k]) * np.array([0.0, -1.0, 0.0]))
        hand = np.array([m.gripper_m[k, 0], 0.1, m.gripper_m[k, 1]])
        wrist = turn * tool[1].inv()
        pose = hand - wrist.apply(tool[0]), wrist
        documents.append([*_transform(_EPOCH_S + t + 0.001, "base", "wrist", pose)])
        tags: list[str] = []
        for i, (x, z) in enumerate(m.markers_m[k].tolist()):
            seen = camera[1].inv().apply(np.array([x, 0.1, z]) - camera[0])
            tags += _transform(_EPOCH_S + t, "optical", f"tag_{i}", (seen, none))
        documents.append(tags)
    echo = "---\n".join("\n".join(["transforms:", *lines, ""]) for lines in documents)
    first = ["transforms:", *_transform(_EPOCH_S, "wrist", "clamp", tool), "---"]
    static = [*first, "transforms:", *_transform(_EPOCH_S, "base", "optical", camera)]
    constant = saved(folder / f"tf_static{Path(name).suffix}", "\n".join(static))
    return saved(folder / name, echo), constant


@pytest.mark.parametrize("name", ["tf_run.yaml", "tf_run.txt"])
def test_chains_of_transforms_are_places_in_the_outermost_frame(name: str, tmp_path: Path) -> None:
    m = made()
    m = replace(m, t_s=m.t_s[:300:3], gripper_m=m.gripper_m[:300:3], angle_rad=m.angle_rad[:300:3],
                markers_m=m.markers_m[:300:3])  # fmt: skip
    echo, static = _echoes(m, tmp_path, name)
    (trial,) = read_trials([echo, static], [], lambda path: path.name)
    assert trial.gripper is not None and trial.gripper_file == f"{name}#clamp"
    hand = trial.gripper.at(["clamp x", "clamp y", "clamp z"])
    np.testing.assert_allclose(hand[:, ::2], m.gripper_m, atol=1e-7)
    np.testing.assert_allclose(hand[:, 1], 0.1, atol=1e-7)
    last = len(NAMES) - 1
    tip = trial.capture.at([f"tag_{last} x", f"tag_{last} z"])
    np.testing.assert_allclose(tip, m.markers_m[:, last], atol=1e-7)
    assert any("of tf_static" in note for note in trial.capture.notes)
    static.unlink()
    (trial,) = _trials(echo)
    assert any("'optical'" in n and "tf_static" in n for n in trial.capture.notes)


def test_a_table_that_names_frames_is_no_document(tmp_path: Path) -> None:
    """As `rostopic echo -p /tf` writes it."""
    rows = [f"{k},tool,{k}.5,2.5" for k in range(9)]
    head = "%time,field.transforms0.child_frame_id,tip.x,tip.y"
    read = read_capture(saved(tmp_path / "tf.txt", "\n".join([head, *rows])))
    assert np.array_equal(read.column("tip.x"), 0.5 + np.arange(9))


# --- streams of one file --------------------------------------------------------------------------


def _messages(m: Swing, begins_ms: float, trial: str) -> list[dict[str, object]]:
    found: list[dict[str, object]] = []
    for event, at_s in (("start", -0.01), ("stop", m.t_s[-1] + 0.01)):
        about = {"event": event, "trial": trial, "ts": begins_ms + at_s * 1e3}
        found.append({"topic": "lab/event", "payload": about})
    for k, t in enumerate(m.t_s):
        ms = begins_ms + t * 1e3
        x, y = (m.gripper_m[k] * 1e3).tolist()
        pose = {"ts": ms, "x_mm": x, "y_mm": y, "angle_deg": float(np.degrees(m.angle_rad[k]))}
        points = [
            {"id": i, "pos_mm": {"x": p[0] * 1e3, "y": p[1] * 1e3}}
            for i, p in enumerate(m.markers_m[k].tolist())
            if (i, k) != (2, 100)
        ]
        found.append({"topic": "lab/robot", "payload": pose})
        found.append({"topic": "lab/camera", "payload": {"ts": ms, "frame": k, "markers": points}})
    return found


def test_topics_are_streams_of_their_own_and_events_frame_trials(tmp_path: Path) -> None:
    first, second = made(), made(seed=2)
    sent = _messages(first, _EPOCH_S * 1e3, "one") + _messages(second, _EPOCH_S * 1e3 + 9e3, "two")
    order = np.random.default_rng(0).permutation(len(sent))  # they arrive late
    file = saved(tmp_path / "mqtt.jsonl", "\n".join(json.dumps(sent[i]) for i in order))
    one, two = _trials(file)
    assert (one.name, two.name) == ("one", "two")
    assert one.gripper is not None and len(one.gripper.values) == len(first.t_s)
    lost = one.capture.column("payload markers 2 pos x")
    assert np.flatnonzero(np.isnan(lost)).tolist() == [100]
    time, told = time_section(one.capture, contents(one.capture), None)
    assert time.seconds_per_unit == 1e-3 and "since 1970" in told.sentence


def test_a_dump_of_topics_is_streams_whatever_its_ending(tmp_path: Path) -> None:
    m, second = made(), made(seed=2)
    lines = ["line7/plc online", "line7/temp 23.4"]
    for count, swing in enumerate((m, second), 1):
        begins_ms = _EPOCH_S * 1e3 + 9e3 * count
        lines.append(f'line7/job {{"run": {count}, "state": "start"}}')  # it has no time
        for message in _messages(swing, begins_ms, "")[2:]:
            topic = {"lab/robot": "line7/arm/tcp", "lab/camera": "line7/cam"}[message["topic"]]
            lines.append(f"{topic} {json.dumps(message['payload'])}")
        lines.append(f'line7/job {{"run": {count}, "state": "done"}}')
    file = saved(tmp_path / "dump.txt", "\n".join([*lines, 'line7/arm/tcp {"ts": 17156']))
    one, two = _trials(file)
    assert (one.name, two.name) == ("trial_1", "trial_2")
    for trial in (one, two):
        assert trial.gripper is not None and len(trial.gripper.values) == len(m.t_s)
        assert len(trial.capture.values) == len(m.t_s)
    torn = [t.name for t in (one, two) if any("line is torn" in n for n in t.capture.notes)]
    assert torn == ["trial_2"]


@pytest.mark.parametrize("name", ["echo.txt", "echo.log", "echo.json"])
def test_json_lines_are_read_whatever_their_ending(name: str, tmp_path: Path) -> None:
    lines = [json.dumps({"time": k / 100, "tip": [k, 2.0], "mode": "move"}) for k in range(9)]
    read = read_capture(saved(tmp_path / name, "\n".join([*lines, lines[0][:9]])))
    assert read.names == ("time", "tip x", "tip y") and len(read.values) == 9
    assert any(":10: the last line is torn" in note for note in read.notes)
    with pytest.raises(InputError, match=r":4: is no JSON"):
        read_capture(saved(tmp_path / name, "\n".join([*lines[:3], lines[0][:9], *lines[3:]])))


def test_a_json_document_is_read_whatever_its_ending(tmp_path: Path) -> None:
    records = [{"time": k / 100, "tip": [k, 2.0]} for k in range(9)]
    read = read_capture(saved(tmp_path / "a.log", json.dumps(records, indent=1)))
    assert read.names == ("time", "tip x", "tip y") and len(read.values) == 9


def test_a_nested_record_with_another_clock_is_a_stream(tmp_path: Path) -> None:
    m = made()
    records = []
    for k, t in enumerate(m.t_s):
        points = [{"id": i, "x": p[0] * 1e3, "y": p[1] * -1e3}
                  for i, p in enumerate(m.markers_m[k].tolist(), 1)]  # fmt: skip
        points += [{"id": 17, "x": 3.0, "y": 150.0}] if k % 20 == 7 else []
        hand = {"t": t + 4781.5, "x": m.gripper_m[k, 0] * 1e3, "z": m.gripper_m[k, 1] * 1e3}
        hand |= {"pitch_deg": float(np.degrees(m.angle_rad[k]))}
        records.append({"t": _EPOCH_S + t, "markers": points, "gripper": hand if k else None})
    file = saved(tmp_path / "run.jsonl", "\n".join(map(json.dumps, records)))
    study = imported([str(file)], tmp_path / "study")
    said = _mapping(tmp_path)
    assert "'marker 17' is seen in" in said
    assert "own axes: they are turned round" in said  # its z is up
    grip, markers = study.trials[0].grip, study.trials[0].markers
    late_s = np.interp(0.5, np.linspace(0, 1, 2), [grip.t_s[0], grip.t_s[-1]])
    assert abs(late_s - 0.5 * (markers.t_s[0] + markers.t_s[-1])) < 0.02
    assert study.arc_length_m.size == len(NAMES)


def test_npz_with_two_clocks_and_an_object(tmp_path: Path) -> None:
    m, file = made(), tmp_path / "trial.npz"
    t_tcp = np.linspace(0.0, m.t_s[-1], 2 * len(m.t_s))
    way = [np.interp(t_tcp, m.t_s, v) for v in m.gripper_m.T * 1e3]
    np.savez(file, dots=m.markers_m * 1e3, t_cam=m.t_s, tcp=np.column_stack(way), t_tcp=t_tcp,
             meta=np.array({"px": 1.0}, dtype=object))  # fmt: skip
    (trial,) = _trials(file)
    assert trial.gripper is not None and trial.gripper.names == ("tcp x", "tcp y", "t_tcp")
    assert trial.capture.column("t_cam").size == len(m.t_s)
    assert any("meta holds no numbers but objects" in note for note in trial.capture.notes)


def test_sheets_with_the_same_columns_are_trials(tmp_path: Path) -> None:
    file, book = tmp_path / "tests.xlsx", Workbook()
    for title in ("Test 1", "Test 2"):
        sheet = book.create_sheet(title)
        sheet.append(["time [ms]", "jaws x", "jaws y", "tip x", "tip y"])
        for k in range(12):
            sheet.append([4 * k, 0.1 * k, 0.0, 50.0 + len(title) * k, 1.0])
    sheet = book.create_sheet("Info")
    for row in (["Frame rate", 250], ["Free length (mm)", 100]):
        sheet.append(row)
    book.save(file)
    assert [(t.name, t.file) for t in _trials(file)] == [
        ("Test_1", "tests.xlsx#Test 1"), ("Test_2", "tests.xlsx#Test 2"),
    ]  # fmt: skip
    assert dict(_trials(file)[0].capture.of_cable) == {"free_length_m": 0.1}
    with pytest.raises(InputError, match="no sheet 'Test 3'"):
        read_capture(tmp_path / "tests.xlsx#Test 3")


# --- times ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "seconds"),
    [
        ("DTL#2024-05-14-09:12:33.295817000", 1715677953.295817),
        ("LDT#2024-05-14-09:12:33", 1715677953.0),
        ("2024-05-14 11:12:33.25+02", 1715677953.25),
        ("2024-05-14 11:12:33+02", 1715677953.0),
        ("2024-05-14 09:12:33,5", 1715677953.5),
        ("2024-05-14T09:12:33.123456789Z", 1715677953.123456789),
        ("14.05.2024 09:12:33,295817000", 1715677953.295817),
    ],
)
def test_a_stamp_is_seconds_since_1970(cell: str, seconds: float) -> None:
    assert number(cell, ",") == pytest.approx(seconds, abs=1e-6)
    assert number("2024-13-14 09:12:33", ".") is None


@pytest.mark.parametrize(("unit", "per_s"), [("s", 1.0), ("ms", 1e3), ("µs", 1e6), ("ns", 1e9)])
def test_times_since_1970_are_told_by_their_size(unit: str, per_s: float, tmp_path: Path) -> None:
    times = [round((_EPOCH_S + 0.004 * k) * per_s, 3) for k in range(20)]
    content = {"columns": ["tip x", "tip y"], "index": times, "data": [[k, 1.0] for k in range(20)]}
    read = read_capture(saved(tmp_path / "split.json", json.dumps(content)))
    time, told = time_section(read, contents(read), None)
    assert time.column == "index" and f"{unit} since 1970" in told.sentence
    assert time.seconds_per_unit == pytest.approx(1.0 / per_s)


def test_a_rate_of_the_whole_file_does_not_stretch_the_times_of_a_faster_log() -> None:
    log = Capture(Path("a.mat"), (CapturedColumn("t"),), np.arange(50.0)[:, None] / 500.0,
                  np.arange(50), rate_hz=200.0)  # fmt: skip
    time, told = time_section(log, contents(log), None)
    assert time.seconds_per_unit == 1.0 and "though the file states 200" in told.sentence


def _stamp(t_s: float, hours: int) -> str:
    return (datetime.fromtimestamp(_EPOCH_S, UTC) + timedelta(hours=hours, seconds=t_s)).strftime(
        "%d.%m.%Y %H:%M:%S.%f"
    )


def test_clocks_of_two_time_zones_are_told(tmp_path: Path) -> None:
    m = made()
    seen = digits(m.markers_m.reshape(len(m.t_s), -1) * 1e3, 7)
    names = ["stamp", *(f"{n}_{a}_mm" for n in NAMES for a in "xy")]
    rows = [[_stamp(t, 0), *row] for t, row in zip(m.t_s, seen, strict=True)]
    markers = saved(tmp_path / "camera.csv", text([names, *rows]))
    poses = digits(np.column_stack([m.gripper_m * 1e3, np.degrees(m.angle_rad)]), 7)
    names = ["time [ms]", "stamp", "x [mm]", "y [mm]", "angle [deg]"]
    rows = [[f"{t * 1e3 - 200:.3f}", _stamp(t, 2), *row]
            for t, row in zip(m.t_s, poses, strict=True)]  # fmt: skip
    hand = saved(tmp_path / "trace.csv", text([names, *rows]))
    said = run(markers, "--hand", hand, "-o", tmp_path / "study", *CABLE)
    assert "camera: -7200 s, -2 h, are added to the gripper's clock" in said
    run(tmp_path / "study" / "import.yaml")
    check_same(read_study(tmp_path / "study"), m, time_s=1e-4)


# --- headers and points ---------------------------------------------------------------------------


def test_axes_may_stand_below_the_units(tmp_path: Path) -> None:
    head = "Time,tip,,,mid,,\ns,mm,mm,mm,mm,mm,mm\n,X,Y,Z,X,Y,Z\n"
    rows = "".join(f"{k / 240:.6g},1,2,{k},4,5,6\n" for k in range(9))
    read = read_capture(saved(tmp_path / "mokka.csv", head + rows))
    assert [p.name for p in contents(read).points] == ["tip", "mid"]
    assert read.columns[3] == CapturedColumn("tip Z", "mm")


def test_a_point_that_is_rarely_seen_is_left_out() -> None:
    noise = np.random.default_rng(0).normal(size=(40, 9))
    values = np.arange(40.0)[:, None] + noise * [0, *[1] * 8] + [0, *np.repeat([0, 9, 18, 27], 2)]
    values[3:, 7:] = np.nan
    names = ["t", *(f"m{i} {a}" for i in range(4) for a in "xy")]
    columns = tuple(CapturedColumn(n) for n in names)
    capture, findings = Capture(Path("a.csv"), columns, values, np.arange(40)), ImportFindings()
    chosen = choose(capture, contents(capture), True, findings)
    assert {p.name for p in chosen.markers} == {"m0", "m1", "m2"}
    assert any("'m3' is seen in 3 of 40 rows" in f.sentence for f in findings)


@pytest.mark.parametrize("index", ["ms since 1970", "rows"])
def test_columns_as_mappings_of_rows_are_upright(tmp_path: Path, index: str) -> None:
    """As pandas writes a table if it is told nothing else."""
    m = made()
    columns = {"grip_x": 1e3 * m.gripper_m[:, 0], "grip_y": 1e3 * m.gripper_m[:, 1]}
    if index == "rows":
        columns = {"time": m.t_s, **columns}
    labels = [str(k if index == "rows" else 1796119200100 + 5 * k) for k in range(len(m.t_s))]
    content = {n: dict(zip(labels, v.tolist(), strict=True)) for n, v in columns.items()}
    (tmp_path / "run.json").write_text(json.dumps(content))
    capture = read_capture(tmp_path / "run.json")
    assert capture.names == (*(["index"] if index != "rows" else []), *columns)
    for name, values in columns.items():
        np.testing.assert_array_equal(capture.column(name), values)
    if index != "rows":
        assert capture.column("index")[1] == 1796119200105
