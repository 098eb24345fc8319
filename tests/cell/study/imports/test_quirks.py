"""What programs write beside the numbers: sections, codes of a sheet, clocks, units, poses."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from cell.cli import app
from cell.study.data import Study
from cell.study.folder import read_study
from cell.study.imports.capture import number
from cell.study.imports.contents import contents
from cell.study.imports.delimited import read_delimited
from cell.study.imports.mcap_file import read_mcap
from cell.study.imports.read import read_c3d, read_capture
from tests.cell.study.imports.made import (
    CABLE,
    LENGTH_M,
    NAMES,
    RATE_HZ,
    Made,
    c3d,
    digits,
    german,
    made,
    mcap_json,
    motive,
    swinging,
    text,
    two_files,
    vicon,
    wide_metres,
)

#: What a file's own numbers are rounded to, m.
ROUNDED_M = 1e-7


def said(arguments: list[str], folder: Path, cable: tuple[str, ...] = CABLE) -> str:
    """What the proposal says, in one line."""
    done = CliRunner().invoke(app, ["import", *arguments, "-o", str(folder), *cable])
    assert done.exit_code == 0, done.output
    return " ".join(done.output.split())


def imported(arguments: list[str], folder: Path) -> Study:
    said(arguments, folder)
    done = CliRunner().invoke(app, ["import", str(folder / "import.yaml")])
    assert done.exit_code == 0, done.output
    return read_study(folder)


def check_same(study: Study, m: Made) -> None:
    (trial,) = study.trials
    origin = [trial.grip.x_m[0], trial.grip.y_m[0]]
    np.testing.assert_allclose(trial.markers.t_s, m.t_s, atol=2e-6)
    there = m.markers_m[:, ::-1] - m.hand_m[0]
    np.testing.assert_allclose(trial.markers.xy_m - origin, there, atol=ROUNDED_M)
    np.testing.assert_allclose(trial.grip.angle_rad, m.angle_rad, atol=2e-6)


# --- numbers of spreadsheets ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "decimal", "value"),
    [
        ("5.000,002", ",", 5000.002),
        ("1.234.567", ",", 1234567.0),
        ("-1,234.5", ".", -1234.5),
        ("5’000.25", ".", 5000.25),
        ("5 000,25", ",", 5000.25),
        ("14:11:10,5", ",", 51070.5),
        ("11:10.2", ".", 670.2),
        ("04.05.2026 14:11:10,25", ",", 1777903870.25),
        ("5/4/2026 2:11:10.25 PM", ".", 1777903870.25),
    ],
)
def test_a_number_of_a_spreadsheet_is_what_it_shows(cell: str, decimal, value: float) -> None:
    assert number(cell, decimal) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize("cell", ["#NV", "#N/A", "#DIV/0!", "#¡VALOR!", "#NOMBRE?"])
def test_an_error_of_a_spreadsheet_is_no_value(cell: str) -> None:
    assert np.isnan(number(cell, "."))


@pytest.mark.parametrize(("cell", "decimal"), [("1,234", "."), ("1.234", ","), ("12.34,5", ",")])
def test_what_may_be_a_decimal_mark_is_no_group_of_thousands(cell: str, decimal) -> None:
    assert number(cell, decimal) in (None, 1.234)


@given(st.floats(-1e9, 1e9).filter(lambda v: abs(v) >= 1000.0))
def test_grouped_numbers_are_read_in_both_conventions(value: float) -> None:
    english = f"{value:,.3f}"
    swapped = english.translate(str.maketrans(",.", ".,"))
    assert number(english, ".") == number(swapped, ",") == pytest.approx(value, abs=6e-4)


def test_a_table_of_windows_with_thousands_and_errors_is_the_trial(tmp_path: Path) -> None:
    m = made()
    (name,) = german(replace(m, hand_m=m.hand_m + 5.0, markers_m=m.markers_m + 5.0), tmp_path)
    lines = Path(name).read_text("utf-8-sig").splitlines()
    rows = [line.split(";") for line in lines[3:]]
    grouped = [
        [
            c.replace("-", "-").replace("5", "5", 1) if i == 0 else _grouped(c)
            for i, c in enumerate(r)
        ]
        for r in rows
    ]
    grouped[200][4] = "#NV"
    head = lines[2].replace("[deg]", "[°]")
    Path(name).write_text(head + "\n" + text(grouped, ";"), encoding="cp1252")
    study = imported([name], tmp_path / "s")
    (trial,) = study.trials
    assert np.isnan(trial.markers.xy_m[200, 0, 0])
    seen = trial.markers.xy_m - [trial.grip.x_m[0], trial.grip.y_m[0]]
    there = m.markers_m[:, ::-1] - m.hand_m[0]
    good = np.isfinite(seen)
    np.testing.assert_allclose(seen[good], there[good], atol=ROUNDED_M)


def _grouped(cell: str) -> str:
    """A number with a decimal comma, its thousands parted by points."""
    whole, mark, part = cell.partition(",")
    return f"{int(whole):,}".replace(",", ".") + mark + part if whole.strip("-0") else cell


# --- several tables in one file -------------------------------------------------------------------


@pytest.mark.parametrize("order", ["after", "before"])
def test_the_section_with_the_markers_is_taken_wherever_it_stands(
    order: str, tmp_path: Path
) -> None:
    m = made()
    (name,) = vicon(m, tmp_path)
    markers = Path(name).read_text()
    forces = np.random.default_rng(3).normal(size=(5 * len(m.t_s), 6))
    rows = [[k // 5 + 1, k % 5, *row] for k, row in enumerate(digits(forces, 4))]
    devices = "Devices\n1000\n,,Plate 1 - Force,,,Plate 1 - Moment,,\n"
    devices += "Frame,Sub Frame,Fx,Fy,Fz,Mx,My,Mz\n,,N,N,N,N.mm,N.mm,N.mm\n" + text(rows)
    parts = [markers, devices] if order == "after" else [devices, markers]
    Path(name).write_text("\n".join(parts))
    study = imported([name], tmp_path / "s")
    (trial,) = study.trials
    assert trial.markers.xy_m.shape == (len(m.t_s), 5, 2)
    assert "another table begins here" in " ".join(read_delimited(Path(name)).notes)


def test_a_section_with_the_same_frames_adds_its_columns(tmp_path: Path) -> None:
    """Vicon writes the angles of bodies into a section of their own."""
    m = made()
    (name,) = vicon(m, tmp_path)
    rows = [[k + 1, 0, *row] for k, row in enumerate(digits(np.degrees(m.angle_rad)[:, None], 9))]
    model = "Model Outputs\n200\n,,rig:Clamp\nFrame,Sub Frame,RY\n,,deg\n" + text(rows)
    Path(name).write_text(model + "\n" + Path(name).read_text())
    found = read_delimited(Path(name))
    assert "rig:Clamp RY" in found.names
    assert found.rate_hz == 200.0
    assert {p.name for p in contents(found).points} >= {"rig clamp", "rig tip"}


def test_a_body_s_markers_and_the_same_ones_alone_are_two_kinds(tmp_path: Path) -> None:
    m = made()
    (name,) = motive(m, tmp_path)
    rows = [line.split(",") for line in Path(name).read_text().splitlines()]
    for kind in ("Rigid Body Marker", "Marker"):
        for k, row in enumerate(rows[2:], 2):
            extra = {2: [kind] * 3, 3: ["Hand:Marker1"] * 3, 4: ["77"] * 3, 5: ["Position"] * 3}
            row += extra.get(k, ["X", "Y", "Z"] if k == 6 else row[6:9])
    Path(name).write_text(text(rows))
    check_same(imported([name], tmp_path / "s"), m)


def test_a_line_of_kinds_below_the_markers_names_is_no_line_of_names(tmp_path: Path) -> None:
    """Qualisys writes the kind of each trajectory there, and no names of columns."""
    m = made()
    head = ["NO_OF_FRAMES\t360", f"FREQUENCY\t{RATE_HZ:.0f}"]
    head += ["MARKER_NAMES\thand\t" + "\t".join(NAMES), "TRAJECTORY_TYPES\t" + "Measured\t" * 5]
    points = np.concatenate([m.hand_m[:, None], m.markers_m], axis=1) * 1e3
    places = np.stack([points[..., 0], np.full(points.shape[:2], 12.0), points[..., 1]], axis=2)
    file = tmp_path / "plain.tsv"
    rows = digits(places.reshape(len(m.t_s), -1), 6)
    file.write_text("\n".join(head) + "\n" + text(rows, "\t"))
    found = read_capture(file)
    assert found.rate_hz == RATE_HZ
    assert [p.name for p in contents(found).points] == ["hand", *NAMES]


# --- recordings -----------------------------------------------------------------------------------


def test_a_recording_without_an_index_is_read_and_a_torn_one_as_far_as_it_goes(
    tmp_path: Path,
) -> None:
    m = made()
    (name,) = mcap_json(m, tmp_path)
    whole = read_mcap(Path(name))
    plain = tmp_path / "plain.mcap"
    with plain.open("wb") as stream:
        writer = Writer(
            stream, compression=CompressionType.NONE, index_types=IndexType.NONE,
            repeat_channels=False, repeat_schemas=False, use_statistics=False,
            use_summary_offsets=False, chunk_size=2_000,
        )  # fmt: skip
        writer.start()
        channel = writer.register_channel("/hand", "json", 0)
        for k in range(300):
            writer.add_message(channel, k * 10**9, b'{"x": 1.0, "y": 2.0}', k * 10**9)
        writer.finish()
    assert read_mcap(plain).values.shape == (300, 3)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(plain.read_bytes()[:-3000])
    found = read_mcap(torn)
    assert 100 < len(found.values) < 300
    assert f"its first {len(found.values)} messages are read" in found.notes[0]
    assert len(whole.values) == len(m.t_s)


@pytest.mark.parametrize("together", [True, False], ids=["one message", "one each"])
def test_transforms_are_told_apart_by_their_frame(together: bool, tmp_path: Path) -> None:
    m, file = made(), tmp_path / "tf.mcap"
    mixed = np.random.default_rng(1)
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/tf", "json", writer.register_schema("tf", "", b""))
        for k, t in enumerate(m.t_s):
            stamp = {"sec": 1_700_000_000 + int(t), "nanosec": round((t - int(t)) * 1e9)}
            places = {"hand": m.hand_m[k], **dict(zip(NAMES, m.markers_m[k], strict=True))}
            each = [
                {
                    "header": {"stamp": stamp, "frame_id": "world"},
                    "child_frame_id": name,
                    "transform": {"translation": {"x": float(x), "y": float(y)}},
                }
                for name, (x, y) in places.items()
            ]
            mixed.shuffle(each)
            for n, message in enumerate([each] if together else [[one] for one in each]):
                at = int(1.7e18 + t * 1e9) + n
                writer.add_message(channel, at, json.dumps({"transforms": message}).encode(), at)
        writer.finish()
    study = imported([str(file)], tmp_path / "s")
    there = m.markers_m[:, ::-1]
    np.testing.assert_allclose(study.trials[0].markers.xy_m, there, atol=1e-9)


def _trimmed(m: Made, folder: Path, first: int, unit: str = "mm") -> Path:
    (name,) = c3d(m, folder)
    content = ezc3d.c3d(name)
    content["header"]["points"]["first_frame"] = first - 1
    content["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file = folder / "trimmed.c3d"
    content.write(str(file))
    return file


def test_a_trimmed_c3d_begins_at_its_first_frame(tmp_path: Path) -> None:
    found = read_c3d(_trimmed(made(), tmp_path, 501))
    whole = read_c3d(tmp_path / "trial.c3d")
    assert found.values[0, 0] - whole.values[0, 0] == pytest.approx(2.5, abs=0.006)


# --- clocks and units -----------------------------------------------------------------------------


def ticking(m: Made, folder: Path, second: float) -> list[str]:
    """Counts of a clock in a column that says no unit."""
    values = np.column_stack([1e6 + m.t_s * second, m.hand_m, m.angle_rad,
                              m.markers_m.reshape(len(m.t_s), -1)])  # fmt: skip
    names = ["timestamp", "hand_x_m", "hand_y_m", "hand_angle_rad"]
    names += [f"{n}_{a}_m" for n in NAMES for a in "xy"]
    file = folder / "ticks.csv"
    file.write_text(text([names, *digits(values, 9)]))
    return [str(file)]


def test_a_stated_rate_decides_what_a_tick_is(tmp_path: Path) -> None:
    m = made()
    study = imported([*ticking(m, tmp_path, 1.25e8), "--rate", "200"], tmp_path / "s")
    t_s = study.trials[0].markers.t_s
    np.testing.assert_allclose(t_s - t_s[0], m.t_s, atol=2e-6)


def test_a_guessed_tick_that_no_cable_swings_by_is_odd(tmp_path: Path) -> None:
    told = said(ticking(made(), tmp_path, 1.25e8), tmp_path / "s")
    assert "1600 rows a second" in told
    assert "check the units of time and length" in told


def test_days_of_a_spreadsheet_are_days(tmp_path: Path) -> None:
    told = said(ticking(made(), tmp_path, 1.0 / 86_400.0), tmp_path / "s")
    assert "day, a guess by steps of" in told


def test_a_rate_that_the_file_contradicts_is_refused_with_both_numbers(tmp_path: Path) -> None:
    (name,) = german(made(), tmp_path)
    told = said([name, "--rate", "100"], tmp_path / "s")
    assert "the file says ms, which makes 200 rows a second, yet --rate says 100" in told
    refused = CliRunner().invoke(app, ["import", str(tmp_path / "s" / "import.yaml")])
    assert refused.exit_code == 2
    assert "seconds_per_unit" in refused.output


def test_a_stated_unit_that_no_cable_has_is_refused_with_the_right_one(tmp_path: Path) -> None:
    m = made()
    file = _trimmed(replace(m, hand_m=m.hand_m / 1e3, markers_m=m.markers_m / 1e3), tmp_path, 1)
    cable = tuple(c for c in CABLE if c not in ("--free-length", str(LENGTH_M)))
    told = said([str(file)], tmp_path / "s", cable)
    assert "give metres_per_unit: 1 if they are m, then they span 0." in told


@pytest.mark.parametrize("scale", [1.0, 1e3], ids=["m", "mm"])
def test_the_hand_s_unit_is_that_by_which_it_moves_as_the_marker_beside(
    scale: float, tmp_path: Path
) -> None:
    m = made()
    arguments = two_files(m, tmp_path)
    poses = np.column_stack([m.t_s, m.hand_m * scale, m.angle_rad])
    Path(arguments[2]).write_text(text([["t", "tcp_x", "tcp_y", "tcp_rz"], *digits(poses, 10)]))
    check_same(imported(arguments, tmp_path / "s"), m)


def test_a_stated_unit_of_the_hand_by_which_it_would_not_move_so_is_told(tmp_path: Path) -> None:
    m = made()
    arguments = two_files(m, tmp_path)
    poses = np.column_stack([m.t_s, m.hand_m, m.angle_rad])
    names = ["t [s]", "tcp_x [mm]", "tcp_y [mm]", "tcp angle [rad]"]
    Path(arguments[2]).write_text(text([names, *digits(poses, 10)]))
    done = CliRunner().invoke(app, ["import", *arguments, "-o", str(tmp_path / "s"), *CABLE])
    told = " ".join(done.output.split())
    assert "it says mm, and would move by 5.1e-05 m, yet in m it moves by 0.051 m" in told
    refused = CliRunner().invoke(app, ["import", str(tmp_path / "s" / "import.yaml")])
    assert refused.exit_code == 2, refused.output


# --- robots ---------------------------------------------------------------------------------------


def _ur(turned: Rotation) -> tuple[list[str], np.ndarray]:
    return [f"actual_TCP_pose_{3 + k}" for k in range(3)], turned.as_rotvec()


def _kuka(turned: Rotation) -> tuple[list[str], np.ndarray]:
    return ["$POS_ACT.A", "$POS_ACT.B", "$POS_ACT.C"], turned.as_euler("ZYX", degrees=True)


def _fanuc(turned: Rotation) -> tuple[list[str], np.ndarray]:
    return ["W", "P", "R"], turned.as_euler("xyz", degrees=True)


def _abb(turned: Rotation) -> tuple[list[str], np.ndarray]:
    return ["q1", "q2", "q3", "q4"], np.roll(turned.as_quat(), 1, axis=1)


@pytest.mark.parametrize(
    ("places", "orientation", "scale"),
    [
        ([f"actual_TCP_pose_{k}" for k in range(3)], _ur, 1.0),
        (["$POS_ACT.X", "$POS_ACT.Y", "$POS_ACT.Z"], _kuka, 1e3),
        (["X", "Y", "Z"], _fanuc, 1e3),
        (["x", "y", "z"], _abb, 1e3),
    ],
    ids=["UR", "KUKA", "Fanuc", "ABB"],
)
def test_a_robot_s_own_record_is_the_hand(
    places: list[str],
    orientation: Callable[[Rotation], tuple[list[str], np.ndarray]],
    scale: float,
    tmp_path: Path,
) -> None:
    """Its plane and origin are proposed; place and turn are those of the truth."""
    m = made()
    arguments = two_files(m, tmp_path)
    hand = np.column_stack([m.hand_m[:, 0], np.zeros(len(m.t_s)), m.hand_m[:, 1]])
    hand = (hand + np.array([0.45, -0.3, 0.2])) * scale
    turned = Rotation.from_rotvec(m.angle_rad[:, None] * [0.0, -1.0, 0.0])
    names, values = orientation(turned * Rotation.from_euler("y", 90, degrees=True))
    rows = digits(np.column_stack([84211.0 + m.t_s, hand, values]), 9)
    Path(arguments[2]).write_text(text([["timestamp", *places, *names], *rows], " "))
    study = imported(arguments, tmp_path / "s")
    (trial,) = study.trials
    moved = np.column_stack([trial.grip.x_m, trial.grip.y_m])
    np.testing.assert_allclose(moved - moved[0], m.hand_m - m.hand_m[0], atol=2e-8)
    np.testing.assert_allclose(moved[0], m.hand_m[0], atol=1e-3)  # by a curve through markers
    turns = trial.grip.angle_rad - trial.grip.angle_rad[0]
    np.testing.assert_allclose(turns, m.angle_rad - m.angle_rad[0], atol=1e-6)


# --- angles ---------------------------------------------------------------------------------------


def _renamed(m: Made, folder: Path, name: str) -> list[str]:
    (file,) = wide_metres(m, folder)
    Path(file).write_text(Path(file).read_text().replace("hand_angle_rad", name, 1))
    return [file]


@pytest.mark.parametrize("name", ["Klemmwinkel [rad]", "phi9 [rad]"])
def test_an_angle_that_the_cable_s_root_follows_is_the_clamp_s(name: str, tmp_path: Path) -> None:
    m = made()
    check_same(imported(_renamed(m, tmp_path, name), tmp_path / "s"), m)


def test_trials_that_rest_at_two_angles_have_no_one_angle(tmp_path: Path) -> None:
    files = []
    for seed, angle in enumerate((0.2, 0.6)):
        folder = tmp_path / str(seed)
        folder.mkdir()
        first = made(seed=seed)
        still = np.full_like(first.t_s, angle)
        (file,) = wide_metres(swinging(first.t_s, first.hand_m, still, seed), folder)
        lines = [line.split(",") for line in Path(file).read_text().splitlines()]
        Path(file).write_text(text([[*line[:3], *line[4:]] for line in lines]))
        files.append(file)
    done = CliRunner().invoke(app, ["import", *files, "-o", str(tmp_path / "s"), *CABLE])
    told = " ".join(done.output.split())
    assert done.exit_code == 1, told
    assert "is one constant, yet at rest the marker next to the gripper is at" in told
