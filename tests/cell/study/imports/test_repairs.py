"""What a file states in remarks and cells, and places that are none: all become one study."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.files.input_error import InputError
from cell.study.imports.read import read_capture
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.swing import Swing
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import (
    CABLE,
    check_same,
    digits,
    imported,
    made,
    run,
    text,
)

_WIDE = ["grip_x_mm", "grip_y_mm", "grip_angle_deg", *(f"{n}_{a}_mm" for n in NAMES for a in "xy")]


def wide(m: Swing) -> np.ndarray:
    """(T, 13): gripper, mm, its angle, deg, and markers, mm."""
    markers_mm = 1e3 * m.markers_m.reshape(len(m.t_s), -1)
    return np.column_stack([1e3 * m.gripper_m, np.degrees(m.angle_rad), markers_mm])


def test_rate_and_unit_stand_among_other_words_of_a_remark(tmp_path: Path) -> None:
    m = made()
    names = ["frame", *(n.removesuffix("_mm") for n in _WIDE)]
    rows = [[k, *row] for k, row in enumerate(digits(wide(m), 7))]
    head = "# scene: swing.blend  fps=200  unit=MILLIMETERS\n"
    file = saved(tmp_path / "a.csv", head + text([names, *rows]))
    check_same(imported([str(file)], tmp_path / "s"), m)


def test_a_unit_behind_each_value_is_that_of_its_column(tmp_path: Path) -> None:
    m = made()
    rows = [[f"{t:g} sec", *row] for t, row in zip(m.t_s, digits(wide(m), 7), strict=True)]
    file = saved(tmp_path / "a.csv", text([["Time", *_WIDE], *rows]))
    check_same(imported([str(file)], tmp_path / "s"), m)


def test_two_units_in_one_column_are_refused(tmp_path: Path) -> None:
    rows = [["0 s", 1, 2], ["5 ms", 1, 2], ["6 s", 1, 3]]
    file = saved(tmp_path / "a.csv", text([["Time", "m1_x", "m1_y"], *rows]))
    with pytest.raises(InputError, match="is in ms, the column in s"):
        read_capture(file)


def test_columns_and_rows_of_an_image_with_the_size_of_a_pixel(tmp_path: Path) -> None:
    m, pixel_mm = made(), 0.25
    values = wide(m) * [1, -1, -1, *[1, -1] * 5] / pixel_mm
    values[:, 2] *= pixel_mm
    names = [
        "t_s",
        "grip_u",
        "grip_v",
        "grip_angle_deg",
        *(f"{n}_{a}" for n in NAMES for a in "uv"),
    ]
    rows = [[f"{t:.6f}", *row] for t, row in zip(m.t_s, digits(values, 7), strict=True)]
    head = f"# mm_per_px={pixel_mm}  (checkerboard)\n"
    file = saved(tmp_path / "a.csv", head + text([names, *rows]))
    check_same(imported([str(file)], tmp_path / "s"), m)


def test_two_sizes_of_a_pixel_are_refused(tmp_path: Path) -> None:
    head = "# mm_per_px=0.25\n# 1 px = 0.3 mm\n"
    file = saved(tmp_path / "a.csv", head + "t,m1_u,m1_v\n0,1,2\n1,1,2\n2,3,4\n")
    with pytest.raises(InputError, match=r"0\.25 mm long here and 0\.3 mm in line 2"):
        read_capture(file)


def test_places_of_two_units_in_one_file(tmp_path: Path) -> None:
    m = made()
    values = wide(m)
    values[:, :2] /= 1e3
    names = ["t_s", "grip_x_m", "grip_y_m", *_WIDE[2:]]
    rows = [[f"{t:.6f}", *row] for t, row in zip(m.t_s, digits(values, 10), strict=True)]
    file = saved(tmp_path / "a.csv", text([names, *rows]))
    check_same(imported([str(file)], tmp_path / "s"), m)


def test_a_number_too_large_for_any_place_is_none(tmp_path: Path) -> None:
    m = made().with_lost_tip()
    rows = [[f"{t:.6f}", *row]
            for t, row in zip(m.t_s, digits(wide(m), 7, "-3.697314E+28"), strict=True)]  # fmt: skip
    file = saved(tmp_path / "a.csv", text([["t_s", *_WIDE], *rows]))
    check_same(imported([str(file)], tmp_path / "s"), m)


def test_a_place_beside_which_visibility_is_0_is_none(tmp_path: Path) -> None:
    lost = made().with_lost_tip()
    stale = lost.markers_m.copy()
    gone = np.isnan(stale[:, -1, 0])
    stale[gone, -1] = stale[int(np.argmax(gone)) - 1, -1]
    values = np.column_stack([wide(replace(lost, markers_m=stale)), ~gone])
    rows = [[f"{t:.6f}", *row] for t, row in zip(lost.t_s, digits(values, 7), strict=True)]
    file = saved(tmp_path / "a.csv", text([["t_s", *_WIDE, "7.V"], *rows]))
    check_same(imported([str(file)], tmp_path / "s"), lost)


def test_a_marker_found_again_under_another_number_is_one(tmp_path: Path) -> None:
    m = made().with_lost_tip()
    values = wide(m)
    again = np.full((len(m.t_s), 2), np.nan)
    again[108:] = values[108:, -2:]
    values[108:, -2:] = np.nan
    names = [*_WIDE[:3], *(f"Unlabeled {k} {a} mm" for k in (7, 4, 9, 3, 12, 40) for a in "xy")]
    cells = digits(np.column_stack([values, again]), 7)
    rows = [[f"{t:.6f}", *row] for t, row in zip(m.t_s, cells, strict=True)]
    file = saved(tmp_path / "a.csv", text([["t_s", *names], *rows]))
    check_same(imported([str(file)], tmp_path / "s"), m)


def _times(m: Swing, values: np.ndarray) -> list[list[str]]:
    """Rows of numbers behind their times."""
    return [[f"{t:.6f}", *row] for t, row in zip(m.t_s, digits(values, 7), strict=True)]


def test_points_behind_the_jaws_are_no_markers_though_nobody_named_them(tmp_path: Path) -> None:
    m = made()
    chain = [m.back_m, m.gripper_m, *m.markers_m.transpose(1, 0, 2)]
    values = 1e3 * np.column_stack(chain)
    names = [f"Marker_{k} {a}" for k in range(1, 8) for a in "xy"]
    file = saved(tmp_path / "a.csv", "Units,mm\n\n" + text([["t_s", *names], *_times(m, values)]))
    out = tmp_path / "s"
    check_same(imported([str(file)], out), m, angle_rad=2e-3)


def test_points_that_move_with_the_gripper_behind_it_are_no_markers(tmp_path: Path) -> None:
    m = made()
    across = np.column_stack([-np.sin(m.angle_rad), np.cos(m.angle_rad)])
    aside = m.back_m + 0.03 * across
    values = np.column_stack([wide(m), 1e3 * m.back_m, 1e3 * aside])
    names = [*_WIDE, *(f"{n}_{a}_mm" for n in ("a", "b") for a in "xy")]
    file = saved(tmp_path / "a.csv", text([["t_s", *names], *_times(m, values)]))
    check_same(imported([str(file)], tmp_path / "s"), m)


def test_a_marker_at_the_gripping_point_is_where_the_cable_begins(tmp_path: Path) -> None:
    """It compares camera and gripper; its arc length came out as −0.01 mm, and was refused."""
    m = made()
    places = np.column_stack([m.gripper_m, m.markers_m.reshape(len(m.t_s), -1)]) * 1e3
    names = ["t_s", *(f"K{k}_{a}_mm" for k in range(6) for a in "xy")]
    file = saved(tmp_path / "a.csv", text([names, *_times(m, places)]))
    pose = np.column_stack([np.add(m.gripper_m, (0.4, 0.2)), np.degrees(m.angle_rad)])
    names = ["t_s", "tcp_x_m", "tcp_y_m", "tcp_angle_deg"]
    hand = saved(tmp_path / "b.csv", text([names, *_times(m, pose)]))
    study = imported([str(file), "--hand", str(hand)], tmp_path / "s")
    np.testing.assert_allclose(
        np.sort(study.arc_length_m), [0.0, 0.02, 0.04, 0.06, 0.08, 0.1], atol=2e-4
    )


@pytest.mark.parametrize("index", ["frame", ""])
def test_an_index_below_names_in_levels_counts_frames_of_which_some_are_missing(
    tmp_path: Path, index: str
) -> None:
    m = made()
    kept = np.delete(np.arange(len(m.t_s)), [70, 71, 150])
    points = ["grip"] * 3 + [n for n in NAMES for _ in "xy"]
    rows = [
        ["point", *points],
        ["coord", "x", "y", "angle", *"xy" * 5],
        ["unit", "mm", "mm", "deg", *["mm"] * 10],
        *([[index, *[""] * 13]] if index else []),
        *([k, *row] for k, row in zip(kept, digits(wide(m)[kept], 7), strict=True)),
    ]
    file = saved(tmp_path / "a.csv", text(rows))
    assert "--rate" in run(file, "-o", tmp_path / "asks", *CABLE, code=1)
    lost = Swing(m.name, m.t_s[kept], m.gripper_m[kept], m.angle_rad[kept], m.markers_m[kept])
    check_same(imported([str(file), "--rate", "200"], tmp_path / "s"), lost)


def test_what_no_file_says_is_asked_for_with_its_option(tmp_path: Path) -> None:
    m = made()
    file = saved(tmp_path / "a.csv", text([_WIDE, *digits(wide(m), 7)]))
    told = run(file, "-o", tmp_path / "s", "--free-length", "0.1", code=1)
    for option in ("--rate", "--line-density", "--width and --thickness, or --diameter"):
        assert option in told


@pytest.mark.parametrize("names", [("U", "V"), ("dX", "dY")])
def test_displacements_are_added_to_places_that_are_constant(
    names: tuple[str, str], tmp_path: Path
) -> None:
    m = made()
    points = ["grip", *NAMES]
    places = 1e3 * np.stack([m.gripper_m, *np.moveaxis(m.markers_m, 1, 0)], axis=1)
    initial = np.broadcast_to(places[:1], places.shape)
    values = np.concatenate([initial, places - initial], axis=2).reshape(len(m.t_s), -1)
    head = ["t_s", *(f"{p} {c} [mm]" for p in points for c in ("X", "Y", *names)), "angle_deg"]
    rows = np.column_stack([m.t_s, values, np.degrees(m.angle_rad)])
    lines = [", ".join(f'"{n}"' for n in head), *(", ".join(row) for row in digits(rows, 7))]
    file = saved(tmp_path / "a.csv", "\n".join(lines))
    assert any("is constant: the displacement" in n for n in read_capture(file).notes)
    check_same(imported([str(file)], tmp_path / "s"), m)


def test_a_place_that_varies_contains_its_displacement(tmp_path: Path) -> None:
    rows = "".join(f"{k},{k},2,{k},0\n" for k in range(4))
    file = saved(tmp_path / "a.csv", "t,m1_x,m1_y,m1_u,m1_v\n" + rows)
    assert np.array_equal(read_capture(file).column("m1_x"), range(4))


def test_a_file_in_which_nothing_moves_is_refused(tmp_path: Path) -> None:
    rows = "".join(f"{k / 100},1,2,3,4\n" for k in range(50))
    file = saved(tmp_path / "a.csv", "t_s,m1_x,m1_y,m2_x,m2_y\n" + rows)
    assert "shows no point that moves" in run(file, "-o", tmp_path / "s", *CABLE, code=2)
