"""Kinds of tables that programs write: each is the study, or is refused with what mends it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cell.study.imports.capture import number
from tests.cell.study.imports.corpus.swing import ARCS_M, LENGTH_M, Swing
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.made import (
    CABLE,
    FORMS,
    check_same,
    digits,
    imported,
    made,
    run,
    text,
    wide_metres,
)

Writer = Callable[[Swing, Path], list[str]]


def _lines(m: Swing, folder: Path) -> list[str]:
    """Lines of the plain table."""
    (name,) = wide_metres(m, folder)
    return Path(name).read_text().splitlines()


def _saved(lines: list[str], file: Path) -> list[str]:
    file.write_text("\n".join(lines) + "\n")
    return [str(file)]


def _edited(edit: Callable[[list[str]], list[str]], name: str = "log.csv") -> Writer:
    return lambda m, folder: _saved(edit(_lines(m, folder)), folder / name)


def _seven_rows_twice(lines: list[str]) -> list[str]:
    return [line for k, line in enumerate(lines) for _ in range(1 + (k % 50 == 7))]


def _sparse(lines: list[str]) -> list[str]:
    """Gripper and markers in rows of their own, as a recorder writes two topics."""
    cells = [line.split(",") for line in lines[1:]]
    rows = [[",".join([*c[:4], *[""] * 10]), ",".join([c[0], "", "", "", *c[4:]])] for c in cells]
    return [lines[0], *(line for pair in rows for line in pair)]


def _series(lines: list[str]) -> list[str]:
    """Each line a series behind its name."""
    return [",".join(cells) for cells in zip(*(line.split(",") for line in lines), strict=True)]


def _received(lines: list[str]) -> list[str]:
    """As a serial monitor shows lines, the first of which it caught in the middle."""
    text_lines = ["0.1,0.2", *lines]
    return [f"14:31:{k * 0.005:06.3f} -> {line}" for k, line in enumerate(text_lines)]


def _commented(lines: list[str]) -> list[str]:
    """A column of remarks, of which only the first row has one."""
    return [f"{lines[0]},Comment", f"{lines[1]},start", *lines[2:]]


def _halves_of_day(lines: list[str]) -> list[str]:
    """Clock times across one o'clock in the afternoon."""
    found = [lines[0].replace("t_s", "Time")]
    for line in lines[1:]:
        t, rest = line.split(",", 1)
        second = 59 * 60 + 59.2 + float(t)
        hour, second = (12, second) if second < 3600 else (1, second - 3600)
        found.append(f"{hour:02d}:{int(second // 60):02d}:{second % 60:06.3f} PM,{rest}")
    return found


def _clock(lines: list[str]) -> list[str]:
    """Times of day in a column whose name is no known one."""
    names, *rows = (line.split(",", 1) for line in lines)
    clock = [f"14:31:{float(t) + 7.512:06.3f},{rest}" for t, rest in rows]
    return [f"Uhrzeit,{names[1]}", *clock]


def melted_by_three_keys(m: Swing, folder: Path) -> list[str]:
    """Influx: parts of one table, each below its remarks, with field, measurement and point."""
    series = [("x", "robot", "tcp", m.gripper_m[:, 0]), ("y", "robot", "tcp", m.gripper_m[:, 1])]
    series += [("angle_rad", "robot", "tcp", m.angle_rad)]
    series += [
        (a, "cable", n, m.markers_m[:, i, k])
        for i, n in enumerate(NAMES)
        for k, a in enumerate("xy")
    ]
    lines: list[str] = []
    for k, (field, group, point, values) in enumerate(series):
        if k % 4 == 0:
            lines += [
                "",
                "#group,false,false,true,false,false,true,true,true",
                "#default,_result,,,,,,,",
            ]
            lines.append(",result,table,_start,_time,_value,_field,_measurement,point")
        lines += [
            f",,{k},2024-03-12T13:00:00Z,{t:.6f},{v:.9f},{field},{group},{point}"
            for t, v in zip(m.t_s, values, strict=True)
        ]
    return _saved(lines[1:], folder / "query.csv")


def _record(m: Swing, k: int) -> dict[str, object]:
    return {
        "t_s": float(m.t_s[k]),
        "gripper": {
            "x_mm": m.gripper_m[k, 0] * 1e3,
            "y_mm": m.gripper_m[k, 1] * 1e3,
            "angle_deg": float(np.degrees(m.angle_rad[k])),
        },
        "points_mm": [[x * 1e3, y * 1e3] for x, y in m.markers_m[k].tolist()],
    }


def lines_of_json(m: Swing, folder: Path) -> list[str]:
    records = [json.dumps(_record(m, k)) for k in range(len(m.t_s))]
    return _saved(records, folder / "track.jsonl")


def json_document(m: Swing, folder: Path) -> list[str]:
    frames = [_record(m, k) for k in range(len(m.t_s))]
    return _saved([json.dumps({"rate": 200, "run": {"frames": frames}})], folder / "track.json")


def _series_of(m: Swing, folder: Path) -> dict[str, list[float]]:
    """Columns of the plain table."""
    head, *rows = (line.split(",") for line in _lines(m, folder))
    return {n: [float(r[i]) for r in rows] for i, n in enumerate(head)}


def json_columns(m: Swing, folder: Path) -> list[str]:
    return _saved([json.dumps(_series_of(m, folder))], folder / "columns.json")


def json_tree(m: Swing, folder: Path) -> list[str]:
    """Arrays at several depths."""
    (x, y), theta = m.gripper_m.T.tolist(), m.angle_rad.tolist()
    points = {
        n: dict(zip("xy", m.markers_m[:, i].T.tolist(), strict=True)) for i, n in enumerate(NAMES)
    }
    tree = {"t": m.t_s.tolist(), "gripper": {"x": x, "y": y, "theta": theta}, "markers": points}
    return _saved([json.dumps({"meta": {"operator": "mk"}, "data": tree})], folder / "run.json")


def feather(m: Swing, folder: Path) -> list[str]:
    arrow = pytest.importorskip("pyarrow")
    from pyarrow.feather import write_feather

    write_feather(arrow.table(_series_of(m, folder)), folder / "run.feather")
    return [str(folder / "run.feather")]


def _spatial(m: Swing) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) of the gripper and (T, 5, 3) of markers, z up, m."""

    def raised(xy: np.ndarray) -> np.ndarray:
        return np.stack([xy[..., 0], 0.3 + 0 * xy[..., 0], xy[..., 1] + 0.9], axis=-1)

    return raised(m.gripper_m), raised(m.markers_m)


def numbered_from_zero(m: Swing, folder: Path, form: str = "{}_x{}_{}") -> list[str]:
    """MuJoCo: numbers of an array's columns, and w first in a quaternion."""
    hand, markers = _spatial(m)
    half = m.angle_rad / 2
    quaternion = np.column_stack([np.cos(half), 0 * half, -np.sin(half), 0 * half])
    names = ["time", *(form.format("gripper", "pos", k) for k in range(3))]
    names += [form.format("gripper", "quat", k) for k in range(4)]
    names += [form.format(f"B{n}", "pos", k) for n in range(5) for k in range(3)]
    values = np.column_stack([m.t_s, hand, quaternion, markers.reshape(len(m.t_s), -1)])
    return _saved(text([names, *digits(values, 9)]).splitlines(), folder / "rollout.csv")


def poses_as_matrices(m: Swing, folder: Path) -> list[str]:
    hand, markers = _spatial(m)
    poses = np.tile(np.eye(4), (len(m.t_s), 1, 1))
    c, s = np.cos(m.angle_rad), np.sin(m.angle_rad)
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = c, -s, s, c
    poses[:, :3, 3] = hand
    stamps = (1_710_245_467_123_456_789 + np.round(m.t_s * 1e9)).astype(np.int64)
    np.savez(folder / "rec.npz", stamps=stamps, markers=markers, T_base_gripper=poses)
    return [str(folder / "rec.npz")]


def of_one_subject(m: Swing, folder: Path) -> list[str]:
    """Vicon: each point of a subject is called after it, and the subject after a gripper."""
    lines = _lines(m, folder)
    names = lines[0].split(",")
    names = [names[0], *(f"Robot:{n.replace('hand', 'gripper')}" for n in names[1:])]
    return _saved([",".join(names), *lines[1:]], folder / "robot.csv")


def another_up(m: Swing, folder: Path) -> list[str]:
    """Markers y up; a robot z up that moves 10 mm level and 50 mm down, from another origin."""
    flat = np.concatenate([m.markers_m, 0.3 + 0 * m.markers_m[..., :1]], axis=2)
    names = ["t_s", *(f"{n}_{a}_m" for n in NAMES for a in "xyz")]
    rows = np.column_stack([m.t_s, flat.reshape(len(m.t_s), -1)])
    hand, _ = _spatial(m)
    pose = np.column_stack([m.t_s, hand, 0 * m.t_s, -m.angle_rad, 0 * m.t_s])
    titles = ["timestamp", *(f"actual_TCP_pose_{k}" for k in range(6))]
    log = _saved(text([titles, *digits(pose, 9)]).splitlines(), folder / "robot.csv")
    marks = _saved(text([names, *digits(rows, 9)]).splitlines(), folder / "swing.csv")
    return [*marks, "--hand", *log]


#: Arc lengths are proposed from shapes whose noise is 50 µm: right to 0.05 % of the cable.
ARC_M = 5e-5
WRITERS: dict[str, Writer] = {form.__name__: form for form in FORMS} | {
    "rows twice": _edited(_seven_rows_twice),
    "two topics": _edited(_sparse),
    "lines are series": _edited(_series),
    "serial monitor": _edited(_received, "serial.log"),
    "a column of remarks": _edited(_commented),
    "half of the day": _edited(_halves_of_day),
    "names again": _edited(lambda x: [*x[:150], x[0], *x[150:]]),
    "remarks at the end": _edited(lambda x: ["# v2", *x, "# stopped", "# 3 packets lost"]),
    "words at the end": _edited(lambda x: ["WAVES/D", x[0], "BEGIN", *x[1:], "END"], "w.itx"),
    "names apart": _edited(lambda x: ["", x[0].replace(",", "  "), ""] + [
        line.replace(",", "  ") for line in x[1:]
    ], "report.rpt"),
    "means at the end": _edited(lambda x: [*x, "", "mean" + ",0.1" * 13]),
    "three keys": melted_by_three_keys,
    "lines of JSON": lines_of_json,
    "JSON document": json_document,
    "JSON columns": json_columns,
    "Feather": feather,
    "numbered from 0": numbered_from_zero,
    "numbered in brackets": lambda m, f: numbered_from_zero(m, f, "{}_{}[{}]"),
    "JSON tree": json_tree,
    "a clock of any name": _edited(_clock),
    "matrices": poses_as_matrices,
    "one subject": of_one_subject,
}  # fmt: skip


@pytest.mark.parametrize("writer", WRITERS.values(), ids=WRITERS)
def test_a_table_of_this_kind_is_the_study(writer: Writer, tmp_path: Path) -> None:
    m = made()
    study = imported(writer(m, tmp_path), tmp_path / "study")
    check_same(study, m)
    assert (study.trials[0].role, study.cable.free_length_m) == ("fit", LENGTH_M)
    np.testing.assert_allclose(study.arc_length_m, ARCS_M[::-1], atol=ARC_M)


def test_a_gap_may_be_any_word_that_is_written_into_all_coordinates(tmp_path: Path) -> None:
    m = made()
    lines = _lines(m, tmp_path)
    for k in (90, 91):
        cells = lines[k].split(",")
        lines[k] = ",".join([*cells[:4], "n. v.", "n. v.", *cells[6:]])
    m.markers_m[[89, 90], -1] = np.nan
    arguments = _saved(lines, tmp_path / "gaps.csv")
    check_same(imported(arguments, tmp_path / "study"), m)
    assert "'n. v.' stands in 4 cells" in run(*arguments, "-o", tmp_path / "said", *CABLE)


def up_of_capture(m: Swing, folder: Path) -> list[str]:
    """Markers z up, and a gripper y up."""
    _, markers = _spatial(m)
    names = ["t_s", *(f"{n}_{a}_m" for n in NAMES for a in "xyz")]
    rows = np.column_stack([m.t_s, markers.reshape(len(m.t_s), -1)])
    half, zero = m.angle_rad / 2, 0 * m.t_s
    hand = [m.t_s, m.gripper_m + 0.4, zero, zero, zero, np.sin(half), np.cos(half)]
    titles = [f"gripper_{a}" for a in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
    log = text([["t_s", *titles], *digits(np.column_stack(hand), 9)])
    marks = text([names, *digits(rows, 9)])
    (hand_file,) = _saved(log.splitlines(), folder / "hand.csv")
    return [*_saved(marks.splitlines(), folder / "cable.csv"), "--hand", hand_file]


@pytest.mark.parametrize("writer", [another_up, up_of_capture])
def test_a_gripper_of_another_frame_keeps_its_angle(writer: Writer, tmp_path: Path) -> None:
    """It was taken as level in the markers' plane, and 22° were added to its angle."""
    m = made()
    study = imported(writer(m, tmp_path), tmp_path / "study")
    grip = study.trials[0].grip
    np.testing.assert_allclose(grip.angle_rad, m.angle_rad, atol=1e-5)
    moved = np.column_stack([grip.x_m, grip.y_m]) - [grip.x_m[0], grip.y_m[0]]
    np.testing.assert_allclose(moved, m.gripper_m - m.gripper_m[0], atol=1e-7)


def test_files_of_one_marker_each_are_told_to_be_joined(tmp_path: Path) -> None:
    m, files = made(), []
    for i, name in enumerate(NAMES):
        rows = digits(np.column_stack([m.t_s, m.markers_m[:, i]]), 9)
        file = tmp_path / f"{name}.csv"
        files += _saved(text([["t_s", "x_m", "y_m"], *rows]).splitlines(), file)
    said = run(*files, "-o", tmp_path / "study", *CABLE, code=2)
    assert "write the columns of all into one file" in said


@pytest.mark.parametrize(
    ("cell", "value"),
    [
        ("12:00:01 AM", 1.0),
        ("12:00:01.5 pm", 43201.5),
        ("1:00:00 PM", 46800.0),
        ("0:00:01:250", 1.25),
        ("1.#QNAN0", np.nan),
        ("-1.#IND", np.nan),
    ],
)
def test_a_clock_with_halves_of_the_day_or_milliseconds(cell: str, value: float) -> None:
    np.testing.assert_equal(number(cell, "."), value)


def test_orientations_that_fill_the_poses_of_points_are_no_clamp_angle(tmp_path: Path) -> None:
    """The clamp angle was 0, for all poses of an array of points had the quaternion 0, 0, 0, 1."""
    m = made()
    points = np.concatenate([m.gripper_m[:, None], m.markers_m], axis=1)
    filler = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*points.shape[:2], 4))
    poses = np.concatenate([points, 0 * points[..., :1], filler], axis=2)
    names = ["time_s"]
    for k in range(points.shape[1]):
        names += [f"poses{k}.position.{a}" for a in "xyz"]
        names += [f"poses{k}.orientation.{a}" for a in "xyzw"]
    rows = digits(np.column_stack([m.t_s, poses.reshape(len(m.t_s), -1)]), 9)
    arguments = _saved(text([names, *rows]).splitlines(), tmp_path / "poses.csv")
    (trial,) = imported(arguments, tmp_path / "study").trials
    np.testing.assert_allclose(trial.grip.angle_rad, m.angle_rad[0], atol=0.05)
