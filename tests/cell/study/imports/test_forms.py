"""Files of one trial in several forms are one study; it goes out as tables and comes back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.cli import app
from cell.study.folder import read_study
from cell.study.imports.mapping import read_mapping
from cell.study.imports.read import read_capture
from cell.study.imports.scales import metres_per_unit
from tests.cell.study.imports.corpus.swing import MARKERS as NAMES
from tests.cell.study.imports.corpus.text import saved
from tests.cell.study.imports.made import (
    CABLE,
    FORMS,
    imported,
    made,
    run,
    text,
)
from tests.cell.study.test_folder import same


def test_an_unusual_unit_of_length_is_doubted() -> None:
    """A table in metres without its gripper was scaled by 2.24, and nothing but the number said
    so."""
    unit, finding = metres_per_unit(set(), 0.0447, 0.1)
    assert unit == pytest.approx(2.237, abs=1e-3)
    assert finding.sentence.endswith(
        "if it is m, they span 0.0447 m: one is missing, or the gripper"
    )


def test_a_newcomer_s_table_is_a_study_in_two_commands(tmp_path: Path) -> None:
    """Millimetres, names of one's own, a frame counter, zeros where a marker was lost."""
    m = made()
    values = np.concatenate([m.gripper_m[:, None], m.markers_m], axis=1) * 1e3 + 300.0
    values[100:104, 3] = 0.0
    flat = values.reshape(len(m.t_s), -1)
    names = ["pic", *(f"{n} {a}" for n in ("pinch", "A", "B", "C", "D", "end") for a in "xy")]
    table = tmp_path / "monday 3.csv"
    table.write_text(text([names, *([k, *row] for k, row in enumerate(flat.tolist()))]))
    command = ["import", str(table), "-o", str(tmp_path / "my_study"), *CABLE, "--rate", "200"]
    proposed = CliRunner().invoke(app, [*command, "--json"])
    assert proposed.exit_code == 0, proposed.output
    found = {f["entry"]: f for f in json.loads(proposed.stdout)["findings"]}
    assert found["metres_per_unit"]["sentence"].startswith("lengths are in mm")
    assert "'pinch'" in found["hand"]["sentence"]
    assert found["hand"]["sure"] == found["hand.angle"]["sure"] == "guessed"
    run(tmp_path / "my_study" / "import.yaml")
    (trial,) = read_study(tmp_path / "my_study").trials
    assert trial.name == "monday_3"
    lost = np.isnan(trial.markers.xy_m[:, 2]).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(lost), [100, 101, 102, 103])
    # The angle is taken from the shape at rest: known to what the noise of 50 µm allows.
    assert trial.grip.angle_rad[0] == pytest.approx(m.angle_rad[0], abs=0.05)


def test_several_files_are_several_trials(tmp_path: Path) -> None:
    files = []
    for number in range(3):
        folder = tmp_path / str(number)
        folder.mkdir()
        files += FORMS[0](made(seed=number), folder)
    study = imported(files, tmp_path / "study")
    assert [t.name for t in study.trials] == ["trial", "trial_2", "trial_3"]
    assert [t.role for t in study.trials] == ["fit", "fit", "validate"]


def test_a_study_goes_out_as_wide_tables_and_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    study = imported(FORMS[0](made(), tmp_path), tmp_path / "study")
    command = ["study", str(tmp_path / "study"), "--csv", str(tmp_path / "tables")]
    out = CliRunner().invoke(app, command)
    assert out.exit_code == 0, out.output
    run(tmp_path / "tables" / "import.yaml", "-o", tmp_path / "again")
    again = read_study(tmp_path / "again")
    same(again, study)


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    arguments = FORMS[0](made(), tmp_path)
    imported(arguments, tmp_path / "study")
    mapping = tmp_path / "study" / "import.yaml"
    edited = mapping.read_text() + "# mine\n"
    mapping.write_text(edited)
    assert "--force" in run(*arguments, "-o", tmp_path / "study", code=2)
    assert "--force" in run(mapping, code=2)
    assert mapping.read_text() == edited
    run(mapping, "--force")


def test_the_hand_s_clock_is_proposed_from_the_motion(tmp_path: Path) -> None:
    m = made()
    late = replace(m, t_s=m.t_s + 0.25)
    arguments = FORMS[-1](m, tmp_path)
    hand = FORMS[-1](late, tmp_path / "late") if (tmp_path / "late").mkdir() is None else []
    arguments[2] = hand[2]
    study = imported(arguments, tmp_path / "study")
    # A marker 20 mm from the gripper moves as the gripper does but for what the cable bends.
    assert study.trials[0].grip.t_s[0] == pytest.approx(0.0, abs=0.01)


def test_one_marker_on_rows_of_its_own_does_not_turn_the_clamp(tmp_path: Path) -> None:
    """Gripper and marker are logged at different times; the line between them is no clamp angle."""
    trial = made()
    tip_m = trial.markers_m[:, -1]
    lines = ["time_s,hand_x_m,hand_y_m,hand_angle_rad,tip_x_m,tip_y_m,Fx [N],Fy [N],Mz [Nm],,"]
    for t, (x, y), angle, tip in zip(
        trial.t_s, trial.gripper_m, trial.angle_rad, tip_m, strict=True
    ):
        lines.append(f"{t},{x},{y},{angle},,,,,,,")
        lines.append(f"{t + 0.001},,,,{tip[0]},{tip[1]},0.1,0.2,0.01,,")
    (tmp_path / "one.csv").write_text("\n".join(lines) + "\n")
    said = run(tmp_path / "one.csv", "-o", tmp_path / "study", *CABLE)
    assert "an offset is added" not in said
    assert "a wrench at the clamp is named as wrench: {columns: [Fx, Fy, Mz]}" in said
    mapping = read_mapping(tmp_path / "study" / "import.yaml").mapping
    assert mapping.hand.angle.offset_rad == 0.0


@pytest.mark.parametrize("stamp", ["", "10:23:44.101 -> "], ids=["bare", "with times of reception"])
@pytest.mark.parametrize("colon, between", [(":", " "), (": ", ", "), ("=", "\t")])
def test_lines_of_names_with_values_are_rows(
    tmp_path: Path, stamp: str, colon: str, between: str
) -> None:
    """As a serial monitor shows what a plotter reads; the first lines are words."""
    m = made()
    values = np.column_stack([
        1e6 * m.t_s, 1e3 * m.gripper_m, np.degrees(m.angle_rad),
        1e3 * m.markers_m.reshape(len(m.t_s), -1),
    ])  # fmt: skip
    names = ["t_us", "grip_x_mm", "grip_y_mm", "grip_deg"]
    names += [f"{n}_{a}_mm" for n in NAMES for a in "xy"]
    lines = ["Cable logger v1.3, build Nov 29", "calibrating... ok"]
    for row in values:
        cells = (f"{n}{colon}{v:.7f}" for n, v in zip(names, row, strict=True))
        lines.append(between.join(cells))
    lines[5] = between.join(lines[5].split(between)[:-2])  # the last marker is not seen
    file = saved(tmp_path / "putty.log", "\n".join(stamp + line for line in lines))
    capture = read_capture(file)
    assert capture.names == tuple(names) and capture.lines[0] == 3
    assert any("putty.log:1: 2 lines are no names with values" in n for n in capture.notes)
    assert np.isnan(capture.values[3, -2:]).all()
    values[3, -2:] = np.nan
    np.testing.assert_allclose(capture.values, values, atol=1e-6)


@pytest.mark.parametrize("names", [("m20", "m60", "tip"), ("20", "60", "tip")])
def test_words_behind_x_and_y_are_points(names: tuple[str, ...], tmp_path: Path) -> None:
    """The pair xtip, ytip was not used, and the others were stretched over the free length."""
    m = made()
    places = np.concatenate([m.gripper_m[:, None], m.markers_m[:, [0, 2, 4]]], axis=1) * 1e2
    columns = ["time", "grip_x", "grip_y", *(f"{a}{n}" for n in names for a in "xy")]
    table = tmp_path / "a.csv"
    rows = np.column_stack([m.t_s, places.reshape(len(m.t_s), -1)])
    table.write_text(text([columns, *rows.tolist()]))
    assert "lengths are in cm" in run(table, "-o", tmp_path / "s", *CABLE)
