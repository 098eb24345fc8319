"""Layouts that programs document: blocks, bodies, sheets, properties, bare names, other frames."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from zipfile import ZipFile

import h5py
import numpy as np
import pytest
from openpyxl import Workbook
from scipy.spatial.transform import Rotation

from cell.study.data import Study
from cell.study.imports.places import find_axes
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.swing import Swing
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import CABLE, check_same, digits, imported, made, run, text

POINTS = ("gripper", *NAMES)


def places(m: Swing) -> np.ndarray:
    """(T, 6, 2) gripping point and markers, m."""
    return np.concatenate([m.gripper_m[:, None], m.markers_m], axis=1)


def upright(at: np.ndarray, up: int = 2) -> np.ndarray:
    """(…, 3) of places in the plane (…, 2), in a room whose axis `up` is the vertical."""
    spatial = np.full((*at.shape[:-1], 3), 0.4)
    spatial[..., 0] += at[..., 0]
    spatial[..., up] += at[..., 1]
    return spatial


def check_places(study: Study, m: Swing, off_m: float = 1e-6) -> None:
    """Markers and gripper are where and when they were; the clamp angle is not compared."""
    check_same(study, m, place_m=off_m, angle_rad=2.0 * np.pi)


def table(folder: Path, name: str, names: Sequence[str], values: np.ndarray) -> str:
    return str(saved(folder / name, text([names, *digits(values, 9)])))


def test_blocks_of_points_under_the_same_names_are_one_table(tmp_path: Path) -> None:
    m, file = made(), tmp_path / "track.txt"
    blocks = []
    for k in range(len(POINTS)):
        rows = digits(np.column_stack([m.t_s * 1e3, places(m)[:, k] * 100.0]), 7)
        blocks.append("#Trajectory data export\n#T X Y\n" + text(rows, " "))
    file.write_text("\n\n".join(blocks))
    check_places(imported([str(file)], tmp_path / "study"), m)


def test_the_sheet_with_points_is_read(tmp_path: Path) -> None:
    m, file, book = made(), tmp_path / "take.xlsx", Workbook()
    first = book.active
    assert first is not None
    first.title = "Orientation"
    first.append(["Frame", *(f"{p} q{i}" for p in POINTS for i in range(4))])
    second = book.create_sheet("Position")
    second.append(["Frame", *(f"{p} {a}" for p in POINTS for a in "xyz")])
    for k, row in enumerate(upright(places(m)).reshape(len(m.t_s), -1)):
        first.append([k, *[1, 0, 0, 0] * len(POINTS)])
        second.append([k, *map(float, row)])
    book.save(file)
    arguments = [str(file), "--rate", "200"]
    said = run(*arguments, "-o", tmp_path / "told", *CABLE)
    assert "sheet 'Position' is read, not 'Orientation'" in said
    check_places(imported(arguments, tmp_path / "study"), m)


def _ods(file: Path, sheets: Mapping[str, Sequence[Sequence[object]]]) -> None:
    """A spreadsheet of OpenDocument, as LibreOffice writes it."""

    def cell(value: object) -> str:
        if isinstance(value, str):
            return f'<table:table-cell office:value-type="string"><text:p>{value}</text:p>'
        return f'<table:table-cell office:value-type="float" office:value="{value}">'

    names = {n: f"urn:oasis:names:tc:opendocument:xmlns:{n}:1.0" for n in ("office", "table")}
    names["text"] = "urn:oasis:names:tc:opendocument:xmlns:text:1.0"
    spaces = " ".join(f'xmlns:{n}="{u}"' for n, u in names.items())
    tables = "".join(
        f'<table:table table:name="{title}">'
        + "".join(
            f"<table:table-row>{''.join(f'{cell(c)}</table:table-cell>' for c in row)}"
            "</table:table-row>"
            for row in rows
        )
        + "</table:table>"
        for title, rows in sheets.items()
    )
    content = f"<office:body><office:spreadsheet>{tables}</office:spreadsheet></office:body>"
    manifest = "urn:oasis:names:tc:opendocument:xmlns:manifest:1.0"
    with ZipFile(file, "w") as book:
        book.writestr("mimetype", "application/vnd.oasis.opendocument.spreadsheet")
        book.writestr("META-INF/manifest.xml", f'<m:manifest xmlns:m="{manifest}"/>')
        book.writestr(
            "content.xml", f"<office:document-content {spaces}>{content}</office:document-content>"
        )


def _xlsx(file: Path, sheets: Mapping[str, Sequence[Sequence[object]]]) -> None:
    book = Workbook()
    for title, rows in sheets.items():
        sheet = book.create_sheet(title)
        for row in rows:
            sheet.append(list(row))
    book.save(file)


def _database(file: Path, sheets: Mapping[str, Sequence[Sequence[object]]]) -> None:
    with closing(sqlite3.connect(file)) as database, database:
        for title, (names, *rows) in sheets.items():
            columns = ", ".join(f'"{name}"' for name in names)
            database.execute(f'CREATE TABLE "{title}" ({columns})')
            places = ", ".join("?" * len(names))
            database.executemany(f'INSERT INTO "{title}" VALUES ({places})', rows)


@pytest.mark.parametrize(
    ("name", "write"), [("a.xlsx", _xlsx), ("a.ods", _ods), ("a.sqlite", _database)]
)
def test_a_sheet_of_the_gripper_alone_is_its_file(
    tmp_path: Path,
    name: str,
    write: Callable[[Path, Mapping[str, Sequence[Sequence[object]]]], None],
) -> None:
    m, file = made(), tmp_path / name
    camera = np.column_stack([m.t_s, 1e3 * m.markers_m.reshape(len(m.t_s), -1)])
    robot = np.column_stack([m.t_s, 1e3 * m.gripper_m, np.degrees(m.angle_rad)])
    of_points = ["time [s]", *(f"{p} {a} [mm]" for p in NAMES for a in "xy")]
    write(
        file,
        {
            "Camera": [of_points, *camera.tolist()],
            "Robot": [["time [s]", "x [mm]", "y [mm]", "angle [deg]"], *robot.tolist()],
        },
    )
    check_same(imported([str(file)], tmp_path / "study"), m)


def test_a_chain_whose_end_swings_with_the_tip_has_no_gripper(tmp_path: Path) -> None:
    m = made()
    values = np.column_stack([m.t_s, 1e3 * m.markers_m.reshape(len(m.t_s), -1)])
    names = ["t_s", *(f"m{i}_{a}_mm" for i in range(len(NAMES)) for a in "xy")]
    said = run(table(tmp_path, "film.csv", names, values), "-o", tmp_path / "s", *CABLE, code=1)
    assert "swings by" in said and "gripper_x and gripper_y" in said
    assert not (tmp_path / "s" / "study.yaml").exists()


def test_a_document_of_lists_with_times_of_their_own_is_one_motion(tmp_path: Path) -> None:
    m, file = made(), tmp_path / "run.json"
    robot = [
        {"t_s": t, "x_m": x, "y_m": y, "angle_rad": angle}
        for t, (x, y), angle in zip(m.t_s.tolist(), m.gripper_m, m.angle_rad, strict=True)
    ]
    frames = [
        {
            "t_s": t,
            "markers": [dict(zip(("x_m", "y_m"), p, strict=True)) | {"name": n} for n, p in at],
        }
        for t, places_m in zip(m.t_s.tolist(), m.markers_m.tolist(), strict=True)
        for at in [list(zip(NAMES, places_m, strict=True))]
    ]
    file.write_text(json.dumps({"by": "me", "robot": robot, "camera": {"frames": frames}}))
    check_same(imported([str(file)], tmp_path / "study"), m)


def test_times_of_day_between_tabs_are_a_column(tmp_path: Path) -> None:
    m = made()
    stamps = [f"14:02:{59 + t:06.3f}" if t < 1.0 else f"14:03:{t - 1.0:06.3f}" for t in m.t_s]
    values = digits(places(m).reshape(len(m.t_s), -1), 9)
    names = ["Time", *(f"{p} {a} [m]" for p in POINTS for a in "XY")]
    rows = [[stamp, *row] for stamp, row in zip(stamps, values, strict=True)]
    file = saved(tmp_path / "log.txt", "a title\n\n" + text([names, *rows], "\t"))
    check_same(imported([str(file)], tmp_path / "s"), m, angle_rad=2.0 * np.pi, time_s=1e-3)


def test_groups_alike_without_times_are_trials(tmp_path: Path) -> None:
    takes, file = (made(1), made(2)), tmp_path / "takes.h5"
    with h5py.File(file, "w") as store:
        for k, m in enumerate(takes):
            group = store.create_group(f"trial_{k}")
            group.attrs["fps"], group.attrs["units"] = 200.0, "m"
            rows = len(m.t_s) - 10 * k
            group["gripper_position"] = upright(m.gripper_m)[:rows]
            group["markers"] = upright(m.markers_m)[:rows]
    study = imported([str(file)], tmp_path / "study")
    assert [t.name for t in study.trials] == ["trial_0", "trial_1"]
    for trial, m in zip(study.trials, takes, strict=True):
        assert trial.markers.xy_m.shape[1] == len(NAMES)
        np.testing.assert_allclose(
            np.ptp(trial.markers.xy_m[:, 0], axis=0), np.ptp(m.markers_m[:, -1], axis=0), atol=1e-4
        )


def test_documents_of_yaml_one_after_another_are_records(tmp_path: Path) -> None:
    """As ROS prints messages."""
    m, file = made(), tmp_path / "poses.yaml"
    messages = [
        {
            "header": {"stamp": {"sec": 1_718_000_000 + int(t), "nanosec": round(t % 1.0 * 1e9)}},
            "poses": [{"position": dict(zip("xyz", p, strict=True))} for p in at.tolist()],
        }
        for t, at in zip(m.t_s.tolist(), upright(places(m)), strict=True)
    ]
    file.write_text("".join(f"{json.dumps(message)}\n---\n" for message in messages))
    check_places(imported([str(file)], tmp_path / "study"), m)


@pytest.mark.parametrize("turned_rad", [0.0, 0.3, 0.8])
def test_markers_beside_the_plane_do_not_turn_it(tmp_path: Path, turned_rad: float) -> None:
    """On both edges of a flat cable, with two marks on the jaw, one on each side of it."""
    m = made()
    depth_m = np.array([-12.0, 12.0, 8.0, -8.0, 8.0, -8.0, 8.0]) * 1e-3
    at = np.zeros((len(m.t_s), len(depth_m), 3))
    in_plane = np.concatenate([m.gripper_m[:, None], places(m)], axis=1)
    at[..., 0] = np.cos(turned_rad) * in_plane[..., 0] - np.sin(turned_rad) * depth_m
    at[..., 1] = np.sin(turned_rad) * in_plane[..., 0] + np.cos(turned_rad) * depth_m
    at[..., 2] = in_plane[..., 1]
    names = ["t_s", *(f"{n}_{a}_m" for n in ("jaw r", "jaw l", *NAMES) for a in "xyz")]
    file = table(tmp_path, "film.csv", names, np.column_stack([m.t_s, at.reshape(len(at), -1)]))
    said = run(file, "-o", tmp_path / "told", *CABLE)
    assert "out of the plane" not in said and "is taken as constant" in said
    check_places(imported([file], tmp_path / "study"), m, off_m=1e-5)


@pytest.mark.parametrize("ends", ["xyz", ("_1", "_2", "_3")])
def test_an_axis_at_the_end_of_a_name_is_one(tmp_path: Path, ends: Sequence[str]) -> None:
    m = made()
    names = ["time", *(f"{n}{a}" for n in ("grip", "knot", "band", "dot", "bead", "tip")
                       for a in ends)]  # fmt: skip
    values = np.column_stack([m.t_s, upright(places(m)).reshape(len(m.t_s), -1)])
    check_places(imported([table(tmp_path, "named.csv", names, values)], tmp_path / "study"), m)


def test_quantities_along_axes_are_no_points(tmp_path: Path) -> None:
    m = made()
    names = ["time", *(f"{n}_{a}" for n in POINTS for a in "xy"), "gyrox", "gyroy", "torquex",
             "torquey"]  # fmt: skip
    values = np.column_stack([m.t_s, places(m).reshape(len(m.t_s), -1), *[m.t_s] * 4])
    check_places(imported([table(tmp_path, "also.csv", names, values)], tmp_path / "study"), m)


def test_numbered_points_of_a_gripper_are_the_gripper_s(tmp_path: Path) -> None:
    m = made()
    back = m.gripper_m + 0.05 * np.column_stack([np.cos(m.angle_rad), np.sin(m.angle_rad)])
    names = ["time", *(f"{n} {a}" for n in ("Grip2", "Grip1", *NAMES) for a in "xy")]
    at = np.concatenate([back[:, None], places(m)], axis=1)
    values = np.column_stack([m.t_s, at.reshape(len(m.t_s), -1)])
    study = imported([table(tmp_path, "two.csv", names, values)], tmp_path / "study")
    check_places(study, m)
    np.testing.assert_allclose(study.trials[0].grip.angle_rad, m.angle_rad, atol=1e-6)


def test_three_lines_of_names_that_repeat_each_other_are_read(tmp_path: Path) -> None:
    m, file = made(), tmp_path / "spots.csv"
    rows: list[list[object]] = [
        ["LABEL", "TRACK_ID", "QUALITY", "POSITION_X", "POSITION_Y", "POSITION_T"],
        ["Label", "Track ID", "Quality", "X", "Y", "T"],
        ["Label", "Track ID", "Quality", "X", "Y", "T"],
        ["", "", "(quality)", "(mm)", "(mm)", "(sec)"],
    ]
    for k in range(len(POINTS)):
        for t, (x, y) in zip(m.t_s, places(m)[:, k] * [1e3, -1e3], strict=True):
            rows.append([f"ID{len(rows)}", k, 41.2, f"{x:.7f}", f"{y:.7f}", f"{t:.6f}"])
    file.write_text(text(rows))
    check_places(imported([str(file)], tmp_path / "study"), m)


def test_rows_of_properties_above_labview_s_table_are_none_of_it(tmp_path: Path) -> None:
    m, file = made(), tmp_path / "take.lvm"
    names = [f"{p} {a}" for p in POINTS for a in "xy"]

    def each(word: str) -> list[str]:
        return [word] * len(names)

    head = [["LabVIEW Measurement"], ["Decimal_Separator", ","], ["***End_of_Header***", ""], [""],
            ["Channels", len(names)], ["Samples", *each("360")], ["Date", *each("2024/02/13")],
            ["Time", *each("14:28:33,13")], ["Y_Unit_Label", *each("mm")], ["X0", *each("0,0E+0")],
            ["Delta_X", *each("0,005000")], ["***End_of_Header***", ""],
            ["X_Value", *names, "Comment"]]  # fmt: skip
    rows = digits(np.column_stack([m.t_s, places(m).reshape(len(m.t_s), -1) * 1e3]), 7)
    rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    file.write_text(text([*head, *rows], "\t"))
    check_places(imported([str(file)], tmp_path / "study"), m)


@pytest.mark.parametrize("names", [(" ", "Track n°", "Slice n°"), ("PID", "TID", "slice")])
def test_rows_of_numbered_tracks_are_points(tmp_path: Path, names: Sequence[str]) -> None:
    m = made()
    rows = [
        [len(m.t_s) * k + i + 1, k + 1, i + 1, *(1e3 * places(m)[i, k])]
        for k in range(len(POINTS))
        for i in range(len(m.t_s))
    ]
    file = table(tmp_path, "tracks.csv", [*names, "X [mm]", "Y [mm]"], np.array(rows))
    check_places(imported([file, "--rate", "200"], tmp_path / "study"), m)


def test_tracks_that_end_go_on_under_another_number_in_any_order(tmp_path: Path) -> None:
    """Without a number, or still, it is no point of the cable."""
    m = made()
    rows = []
    for i in range(len(m.t_s)):
        for k in range(len(POINTS)):
            if (k, i) not in {(2, 180), (2, 181), (2, 240)}:
                track = (50 if i > 240 else 40) if k == 2 and i > 181 else 7 - k
                rows.append([i + 1, track, *(1e3 * places(m)[i, k])])
        rows.append([i + 1, 11, -200.0, 300.0])
    rows.insert(30, [5, np.nan, 4.0, 5.0])
    file = table(tmp_path, "spots.csv", ["FRAME", "TRACK_ID", "X [mm]", "Y [mm]"], np.array(rows))
    study = imported([file, "--rate", "200"], tmp_path / "study")
    truth = places(m)[:, ::-1] - places(m)[0, 0]
    seen = study.trials[0].markers.xy_m
    own = np.isfinite(seen[..., 0])
    assert (~own).sum() == 3
    np.testing.assert_allclose(seen[own], truth[:, : seen.shape[1]][own], atol=1e-3)
    said = run(file, "--rate", "200", "-o", tmp_path / "told", *CABLE)
    assert "those that go on under another number are joined: 40 with 5, 50 with 5;" in said


def test_a_single_point_without_a_gripper_is_refused_with_the_ways(tmp_path: Path) -> None:
    m = made()
    values = np.column_stack([m.t_s, m.markers_m[:, -1]])
    file = table(tmp_path, "one.csv", ["t_s", "tip_x_m", "tip_y_m"], values)
    said = run(file, "-o", tmp_path / "told", *CABLE, code=2)
    assert "one.csv:2: shows one point and no gripper: give a file of the gripper" in said
    assert "Columns: t_s, tip_x_m, tip_y_m" in said


# --- a gripper in a file of its own ---------------------------------------------------------------


def test_a_body_s_name_stands_over_all_its_columns(tmp_path: Path) -> None:
    m = made()
    at = upright(places(m)) * 1e3
    markers = tmp_path / "points.tsv"
    names = ["Frame", "Time", *(f"{n} {a}" for n in NAMES for a in "XYZ")]
    rows = digits(np.column_stack([m.t_s, at[:, 1:].reshape(len(m.t_s), -1)]), 7)
    markers.write_text(text([names, *([k + 1, *row] for k, row in enumerate(rows))], "\t"))
    body = tmp_path / "body.tsv"
    names = ["Gripper X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", "Rot[0]"]
    pitch = np.degrees(m.angle_rad)
    zero = np.zeros_like(pitch)
    values = np.column_stack([at[:, 0], zero, -pitch, zero, zero + 0.1, np.cos(m.angle_rad)])
    body.write_text("FREQUENCY\t200\n" + text([names, *digits(values, 7)], "\t"))
    study = imported([str(markers), "--hand", str(body)], tmp_path / "study")
    check_places(study, m)
    np.testing.assert_allclose(study.trials[0].grip.angle_rad, m.angle_rad, atol=1e-6)


def test_one_frame_in_two_units_that_nobody_states_is_seen(tmp_path: Path) -> None:
    m = made()
    at = upright(places(m))
    names = ["time", *(f"{n} {a}" for n in NAMES for a in "xyz")]
    values = np.column_stack([m.t_s, at[:, 1:].reshape(len(m.t_s), -1) * 1e3])
    markers = table(tmp_path, "markers.csv", names, values)
    hand = table(
        tmp_path, "hand.csv", ["time", "tcp x", "tcp y", "tcp z"],
        np.column_stack([m.t_s, at[:, 0]]),
    )  # fmt: skip
    said = run(markers, "--hand", hand, "-o", tmp_path / "told", *CABLE)
    assert "from the gripper's place at rest on" in said
    study = imported([markers, "--hand", hand], tmp_path / "study")
    check_places(study, m)
    arcs_m = np.sort(study.arc_length_m)
    np.testing.assert_allclose(arcs_m, [0.02, 0.04, 0.06, 0.08, 0.1], atol=2e-4)


def test_a_gripper_across_the_markers_plane_has_axes_of_its_own(tmp_path: Path) -> None:
    m = made()
    names = ["time", *(f"{n} {a} [mm]" for n in NAMES for a in "xyz")]
    of_cable = upright(m.markers_m, up=1).reshape(len(m.t_s), -1) * 1e3
    markers = table(tmp_path, "markers.csv", names, np.column_stack([m.t_s, of_cable]))
    hand = table(
        tmp_path, "robot.csv", ["time", "tcp x [m]", "tcp y [m]", "tcp z [m]"],
        np.column_stack([m.t_s, upright(m.gripper_m)]),
    )  # fmt: skip
    study = imported([markers, "--hand", hand], tmp_path / "study")
    grip = study.trials[0].grip
    moved = np.column_stack([grip.x_m - grip.x_m[0], grip.y_m - grip.y_m[0]])
    np.testing.assert_allclose(moved, m.gripper_m - m.gripper_m[0], atol=1e-6)


def test_the_first_frame_is_time_0_of_a_log(tmp_path: Path) -> None:
    m = made()
    frames = np.arange(1, len(m.t_s) + 1)
    names = ["frame", *(f"{n} {a} [mm]" for n in NAMES for a in "xy")]
    values = np.column_stack([frames, m.markers_m.reshape(len(m.t_s), -1) * 1e3])
    markers = table(tmp_path, "markers.csv", names, values)
    log_s = np.arange(0.0, 1.8, 0.004)
    at = [np.interp(log_s, m.t_s, v) for v in m.gripper_m.T]
    hand = table(
        tmp_path, "log.csv", ["t [s]", "tcp x [m]", "tcp y [m]"], np.column_stack([log_s, *at])
    )
    arguments = [markers, "--hand", hand, "--rate", "200"]
    assert "the first is taken as time 0" in run(*arguments, "-o", tmp_path / "told", *CABLE)
    check_places(imported(arguments, tmp_path / "study"), m, off_m=2e-5)


def test_a_message_s_own_stamp_goes_before_its_arrival(tmp_path: Path) -> None:
    m = made()
    late_s = np.random.default_rng(3).uniform(0.0, 0.004, len(m.t_s))
    names = ["%time", "field.header.stamp", *(f"{n} {a}" for n in POINTS for a in "xy")]
    values = np.column_stack([m.t_s + late_s, m.t_s, places(m).reshape(len(m.t_s), -1)])
    check_places(imported([table(tmp_path, "bag.csv", names, values)], tmp_path / "study"), m)


def test_an_angle_that_a_body_is_turned_by_is_told(tmp_path: Path) -> None:
    m = made()
    half = 0.5 * (m.angle_rad + 0.5)
    names = ["time", *(f"{n} {a}" for n in POINTS for a in "xy")]
    names += [f"gripper q{a}" for a in "xyzw"]
    values = [m.t_s, places(m).reshape(len(m.t_s), -1), 0 * half, 0 * half, np.sin(half)]
    file = table(tmp_path, "body.csv", names, np.column_stack([*values, np.cos(half)]))
    assert "turned by -" in run(file, "-o", tmp_path / "told", *CABLE)


# --- images ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "told"),
    [
        ([2600.0, 2600.0], "multiply x by its width and y by its height"),
        ([1.1, 1.1], "if these are pixels, give metres_per_unit"),
    ],
)
def test_a_unit_of_an_image_is_a_guess(tmp_path: Path, size: list[float], told: str) -> None:
    m = made()
    image = (places(m) * [1.0, -1.0] + [0.15, 0.05]) * 1e3 / size
    names = ["time", *(f"{n} {a}" for n in POINTS for a in "xy")]
    values = np.column_stack([m.t_s, image.reshape(len(m.t_s), -1)])
    file = table(tmp_path, "image.csv", names, values)
    said = run(file, "-o", tmp_path / "told", *CABLE)
    assert told in said.partition("Guesses, to be checked:")[2]


def test_units_stand_above_what_has_measured_the_columns(tmp_path: Path) -> None:
    m = made()
    columns = np.column_stack([m.t_s, 1e3 * places(m).reshape(len(m.t_s), -1), 20.0 + 0.0 * m.t_s])
    named = ["Zeit", *(f"{p}_{a}" for p in POINTS for a in "xy"), "Raum"]
    units = ["s", *["mm"] * (len(named) - 2), "°C"]
    sensors = ["Uhr", *["Kamera"] * (len(named) - 2), "Pt100"]
    file = saved(tmp_path / "take.txt", text([named, units, sensors, *digits(columns, 9)], "\t"))
    check_places(imported([str(file)], tmp_path / "study"), m)
    assert "lengths are in mm, as the file says" in run(file, "-o", tmp_path / "again", code=1)


@pytest.mark.parametrize(("down", "up"), [([0.0, 1.0], [0.0, -1.0]), ([0.1, -1.0], [0.0, 1.0])])
def test_a_cable_that_is_straight_at_rest_hangs(down: list[float], up: list[float]) -> None:
    """In a picture the second coordinate points down: the study stood on its head."""
    shape = np.linspace(0.0, 0.1, 5)[:, None] * np.array(down)
    section, findings = find_axes(np.repeat(shape[None], 20, axis=0), shape)
    assert section.up == up
    assert any("straight at rest, hangs" in f.sentence for f in findings)


def test_a_body_s_matrix_tells_more_than_one_of_its_three_angles(tmp_path: Path) -> None:
    m = made()
    turned = Rotation.from_euler("z", 30.0, degrees=True) * Rotation.from_euler(
        "y", -m.angle_rad[:, None]
    )
    spatial = upright(places(m)) @ Rotation.from_euler("z", 30.0, degrees=True).as_matrix().T
    angles = np.degrees(turned.as_euler("xyz"))
    matrix = turned.as_matrix().transpose(0, 2, 1).reshape(len(m.t_s), 9)
    named = ["Time (s)", *(f"{p} {a} (mm)" for p in POINTS for a in "XYZ")]
    named += [f"gripper {a}" for a in ("Roll", "Pitch", "Yaw")]
    named += [f"gripper Rot[{k}]" for k in range(9)]
    values = np.column_stack([m.t_s, 1e3 * spatial.reshape(len(m.t_s), -1), angles, matrix])
    said = run(table(tmp_path, "body.csv", named, values), "-o", tmp_path / "study", *CABLE)
    assert "the gripper turns as 'gripper quaternion x'" in said


def test_each_channel_has_its_own_times(tmp_path: Path) -> None:
    """Properties in turns with their names above the channels, as TwinCAT's Scope exports them."""
    m = made()
    names = ["Greifer X", "Greifer Y", *(f"Marker{k} {a}" for k in range(5) for a in "XY")]
    head = [
        [cell for n in names for cell in ("Name", n)],
        ["SampleTime[ms]", "5"] * len(names),
        [cell for _ in names for cell in ("Unit", "mm (Length)")],
    ]
    each = places(m).reshape(len(m.t_s), -1) * 1e3
    frames = np.arange(len(m.t_s))
    logged = np.append(0, frames[1::2])
    rows = []
    for i in frames:
        row = []
        for k, name in enumerate(names):
            own = logged if name.startswith("Greifer") else frames
            there = [f"{m.t_s[own[i]] * 1e3:.3f}", f"{each[own[i], k]:.7f}"] if i < len(own) else []
            row += [cell.replace(".", ",") for cell in there] or ["", ""]
        rows.append(row)
    file = saved(tmp_path / "scope.csv", text([["File", "a"], *head, [], *rows, ["EOF"]], "\t"))
    check_same(imported([str(file)], tmp_path / "study"), m, place_m=1e-4, angle_rad=0.5)


@pytest.mark.parametrize("gap", ["", "nan"])
def test_units_stand_in_cells_of_which_many_are_empty(tmp_path: Path, gap: str) -> None:
    """The gripper's rows are others than the camera's; the first has no marker."""
    m = made()
    both = digits(places(m).reshape(len(m.t_s), -1) * 1e3, 7)
    rows = []
    for t, cells in zip(m.t_s, both, strict=True):
        with_units = [f"{cell} mm" for cell in cells]
        rows.append([f"{t:.6f}", *with_units[:2], *[gap] * 10])
        rows.append([f"{t + 1e-5:.6f}", gap, gap, *with_units[2:]])
    names = ["time_s", *(f"{p}_{a}" for p in POINTS for a in "xy")]
    file = saved(tmp_path / "joined.csv", text([names, *rows]))
    check_same(imported([str(file)], tmp_path / "study"), m, place_m=3e-4, angle_rad=0.5)


def test_a_line_of_numbers_stands_above_the_names(tmp_path: Path) -> None:
    """Numbers of the columns, below lines of a property and its value, as Simi Motion exports."""
    m = made()
    names = ["Einspannung X", "Einspannung Y", *(f"{p} {a}" for p in NAMES for a in "XY")]
    values = digits(places(m).reshape(len(m.t_s), -1), 9)
    head = [["Samples", len(values)], ["SamplesPerSecond", "200"], []]
    rows = [*head, [1000 + i // 2 for i in range(12)], names, *values]
    file = saved(tmp_path / "simi.txt", text(rows, "\t"))
    check_places(imported([str(file), "--rate", "200"], tmp_path / "study"), m)


def test_small_digits_number_points(tmp_path: Path) -> None:
    m = made()
    names = ["t", "hand_x", "hand_y", *(f"{a}{n}" for n in "₁₂₃₄₅" for a in "xy")]
    values = np.column_stack([m.t_s, places(m).reshape(len(m.t_s), -1)])
    check_places(imported([table(tmp_path, "small.csv", names, values)], tmp_path / "study"), m)


def test_displacements_beside_places_are_no_points(tmp_path: Path) -> None:
    m = made()
    at = places(m)
    names = ["t_s", *(f"{p} m.{k}{a}" for p in POINTS for k in ("", "d") for a in "XY")]
    both = np.concatenate([at, at - at[0]], axis=2).reshape(len(m.t_s), -1)
    file = table(tmp_path, "stages.csv", names, np.column_stack([m.t_s, both]))
    check_places(imported([file], tmp_path / "study"), m)


def test_markers_of_a_body_whose_file_is_another_are_none_of_the_cable(tmp_path: Path) -> None:
    """Nobody named them after the gripper: with them the chain is longer than the cable."""
    m = made()
    behind = m.gripper_m[:, None] + np.array([[0.03, 0.004], [0.06, 0.02], [0.1, 0.01]])
    every = np.concatenate([behind, m.markers_m], axis=1).reshape(len(m.t_s), -1) * 1e3
    names = ["t_s", *(f"M{k}_{a}_mm" for k in range(8) for a in "xy")]
    markers = table(tmp_path, "points.csv", names, np.column_stack([m.t_s, every]))
    poses = np.column_stack([m.t_s, m.gripper_m * 1e3, m.angle_rad])
    hand = table(tmp_path, "body.csv", ["t_s", "jaws_x_mm", "jaws_y_mm", "angle_rad"], poses)
    said = run(markers, "--hand", hand, "-o", tmp_path / "told", *CABLE)
    assert "'m2', 'm1', 'm0': on the gripper" in said or "on the gripper, for with them" in said
    check_same(imported([markers, "--hand", hand], tmp_path / "study"), m, angle_rad=1e-3)


def test_what_bends_in_several_trials_tells_which_axis_is_up() -> None:
    """A stiff cable whose clamp is turned up by 75° bends level; the next trial is level."""
    turned = [np.array([1.31, 1.2, 1.1]), np.array([0.0, -0.1, -0.3])]
    shapes = [
        np.vstack([[0.0, 0.0], np.cumsum(np.column_stack([np.cos(a), np.sin(a)]), axis=0)])
        for a in turned
    ]
    assert find_axes(shapes[0][None], shapes[0])[0].up == [-1.0, 0.0]
    assert find_axes(shapes[0][None], shapes[0], shapes[1:])[0].up == [0.0, 1.0]
