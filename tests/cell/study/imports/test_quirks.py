"""What programs write beside the numbers: sections, codes of a sheet, clocks, units, poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from cell.study.imports.capture import number
from tests.cell.study.imports.corpus.swing import ARCS_M, Swing, swing
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import (
    CABLE,
    NOISE_M,
    check_same,
    digits,
    german,
    imported,
    made,
    run,
    text,
    two_files,
    wide_metres,
)


def said(arguments: list[str], folder: Path, code: int = 0) -> str:
    """What the proposal says, in one line."""
    return run(*arguments, "-o", folder, *CABLE, code=code)


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


# --- clocks and units -----------------------------------------------------------------------------


def ticking(m: Swing, folder: Path, second: float) -> list[str]:
    """Counts of a clock in a column that says no unit."""
    values = np.column_stack([1e6 + m.t_s * second, m.gripper_m, m.angle_rad,
                              m.markers_m.reshape(len(m.t_s), -1)])  # fmt: skip
    names = ["timestamp", "hand_x_m", "hand_y_m", "hand_angle_rad"]
    names += [f"{n}_{a}_m" for n in NAMES for a in "xy"]
    return [str(saved(folder / "ticks.csv", text([names, *digits(values, 9)])))]


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
    told = said([name, "--rate", "100"], tmp_path / "s", code=1)
    assert "the file says ms, which makes 200 rows a second, yet --rate says 100" in told
    assert "seconds_per_unit" in run(tmp_path / "s" / "import.yaml", code=2)


def test_a_stated_unit_that_no_cable_has_is_refused_with_the_right_one(tmp_path: Path) -> None:
    m = made()
    (name,) = german(replace(m, gripper_m=m.gripper_m / 1e3, markers_m=m.markers_m / 1e3), tmp_path)
    told = run(name, "-o", tmp_path / "s", *CABLE[2:], code=1)
    assert "give metres_per_unit: 1 if they are m, then they span 0." in told


def test_a_stated_unit_of_the_hand_by_which_it_would_not_move_so_is_told(tmp_path: Path) -> None:
    m = made()
    arguments = two_files(m, tmp_path)
    poses = np.column_stack([m.t_s, m.gripper_m, m.angle_rad])
    names = ["t [s]", "tcp_x [mm]", "tcp_y [mm]", "tcp angle [rad]"]
    Path(arguments[2]).write_text(text([names, *digits(poses, 10)]))
    told = said(arguments, tmp_path / "s", code=1)
    assert "it says mm, and would move by 5.1e-05 m, yet in m it moves by 0.051 m" in told
    run(tmp_path / "s" / "import.yaml", code=2)


# --- angles ---------------------------------------------------------------------------------------


def _renamed(m: Swing, folder: Path, name: str) -> list[str]:
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
        (file,) = wide_metres(
            swing("rest", first.gripper_m, still, seed, first.t_s, NOISE_M), folder
        )
        lines = [line.split(",") for line in Path(file).read_text().splitlines()]
        Path(file).write_text(text([[*line[:3], *line[4:]] for line in lines]))
        files.append(file)
    told = run(*files, "-o", tmp_path / "s", *CABLE, code=1)
    assert "is one constant, yet at rest the marker next to the gripper is at" in told


def test_a_marker_at_the_gripper_shows_no_angle(tmp_path: Path) -> None:
    files = []
    for seed in range(2):
        folder = tmp_path / str(seed)
        folder.mkdir()
        m = swing("rest", made(seed).gripper_m, np.full_like(made().t_s, 0.2), seed, made().t_s)
        (file,) = wide_metres(m, folder)
        rows = [line.split(",") for line in Path(file).read_text().splitlines()]
        dot_m = m.gripper_m + np.random.default_rng(seed).normal(0.0, NOISE_M, m.gripper_m.shape)
        dots = [["m0_x_m", "m0_y_m"], *digits(dot_m, 7)]
        Path(file).write_text(
            text([[*r[:3], *r[4:], *dot] for r, dot in zip(rows, dots, strict=True)])
        )
        files.append(file)
    run(*files, "-o", tmp_path / "s", *CABLE, "--clamp-angle", "0.2")
    mapping = tmp_path / "s" / "import.yaml"
    content = yaml.safe_load(mapping.read_text())
    assert content["markers"][0]["columns"][0] == "m1_x_m"
    dot = {"name": "m0", "columns": ["m0_x_m", "m0_y_m"], "arc_length_m": 0.0}
    content["markers"].insert(0, dot)
    mapping.write_text(yaml.safe_dump(content))
    run(mapping)


def test_a_marker_at_the_gripper_needs_no_arc_length(tmp_path: Path) -> None:
    m = made()
    places = np.column_stack([m.gripper_m, m.markers_m.reshape(len(m.t_s), -1)]) * 1e3
    names = ["t_s", *(f"K{k}_{a}_mm" for k in range(6) for a in "xy")]
    rows = np.column_stack([m.t_s, places])
    file = saved(tmp_path / "a.csv", text([names, *digits(rows, 7)]))
    pose = np.column_stack([m.t_s, np.add(m.gripper_m, (0.4, 0.2)), np.degrees(m.angle_rad)])
    names = ["t_s", "tcp_x_m", "tcp_y_m", "tcp_angle_deg"]
    hand = saved(tmp_path / "b.csv", text([names, *digits(pose, 7)]))
    arcs = ",".join(f"{s:g}" for s in ARCS_M)
    run(file, "--hand", hand, "-o", tmp_path / "s", *CABLE, "--arc-lengths", arcs)
    assert [arc_m for arc_m, _ in _arcs_of(tmp_path / "s")] == [0.0, *ARCS_M]


# --- arc lengths ----------------------------------------------------------------------------------


def _arcs_of(folder: Path) -> list[tuple[float, float | None]]:
    markers = yaml.safe_load((folder / "import.yaml").read_text())["markers"]
    return [(m["arc_length_m"], m.get("arc_length_std_m")) for m in markers]


@pytest.mark.parametrize("arcs", ["0.021, 0.04,0.06,0.08 0.1", "0,0.021,0.04,0.06,0.08,0.1"])
def test_arc_lengths_are_the_stated_ones(arcs: str, tmp_path: Path) -> None:
    """The gripping point's own may be among them."""
    (file,) = wide_metres(made(), tmp_path)
    told = run(file, "-o", tmp_path / "s", *CABLE, "--arc-lengths", arcs)
    assert "arc lengths are those of --arc-lengths" in told
    assert _arcs_of(tmp_path / "s") == [(s, None) for s in (0.021, 0.04, 0.06, 0.08, 0.1)]


@pytest.mark.parametrize(
    ("arcs", "told"),
    [
        ("0.02,0.04,0.06,0.1", "has 4 values, but 5 markers are found; give one for each, 0 for"),
        ("0.02,0.06,0.1", "has 3 values, but 5 markers are found"),
        ("", "does not rise"),
        ("0.02,0.04,nan,0.08,0.1", "does not rise"),
        ("0.02,0.04,0.06,0.08,inf", "does not rise"),
        ("0.1,0.08,0.06,0.04,0.02", "does not rise from the gripper to the tip; order"),
        ("20,40,60,80,100", "puts marker 5 from the gripper at 100 m, yet on the curve"),
        ("0.02,0.055,0.06,0.08,0.1", "puts marker 2 from the gripper at 0.055 m, yet"),
        ("2 cm", "'2 cm' holds no numbers; give metres, as 0.02,0.05,0.1"),
    ],
)
def test_arc_lengths_that_the_markers_contradict_are_refused(
    arcs: str, told: str, tmp_path: Path
) -> None:
    (file,) = wide_metres(made(), tmp_path)
    assert told in run(file, "-o", tmp_path / "s", *CABLE, "--arc-lengths", arcs, code=2)
    assert not (tmp_path / "s").exists()


def _long_table(folder: Path, name: str, factor: float = 1.0) -> Path:
    """Rows of points with a column of their arc lengths, mm, times a factor."""
    m = made()
    points = [("hand", 0.0, m.gripper_m)]
    points += [
        (n, s, m.markers_m[:, k]) for k, (n, s) in enumerate(zip(NAMES, ARCS_M, strict=True))
    ]
    rows = [[f"{t:.6f}", point, f"{1e3 * factor * arc:g}", f"{x:.7f}", f"{y:.7f}"]
            for k, t in enumerate(m.t_s) for point, arc, xy in points
            for x, y in [1e3 * xy[k]]]  # fmt: skip
    return saved(folder / "a.csv", text([["t_s", "point", name, "x_mm", "y_mm"], *rows]))


def test_a_column_with_one_value_for_each_point_holds_arc_lengths(tmp_path: Path) -> None:
    file = _long_table(tmp_path, "along_mm")
    told = run(file, "-o", tmp_path / "s", *CABLE, "--clamp-angle", "0.2")
    assert "arc lengths are those of column 'along'" in told
    assert "m1 along" not in told
    assert _arcs_of(tmp_path / "s") == [(pytest.approx(s), None) for s in ARCS_M]


@pytest.mark.parametrize(("name", "factor"), [("x0_mm", 1.0), ("along_mm", 0.9), ("along", 1.0)])
def test_a_column_that_may_be_another_quantity_holds_no_arc_lengths(
    name: str, factor: float, tmp_path: Path
) -> None:
    """Of an axis, against the curve through the markers, or without a unit of length."""
    file = _long_table(tmp_path, name, factor)
    told = run(file, "-o", tmp_path / "s", *CABLE, "--clamp-angle", "0.2")
    assert "arc lengths are those of a curve through the markers" in told
