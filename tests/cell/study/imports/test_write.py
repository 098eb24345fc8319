"""A study goes out as wide tables with a mapping, and comes back with all that it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.cable.geometry import Cable, Connector, Motion
from cell.cable.wrench import Gauge, Tool
from cell.files.input_error import InputError
from cell.study.data import Markers, Study, Trial, Wrench, WrenchSensor
from cell.study.folder import read_study
from cell.study.hand_drift import HandDrift
from cell.study.imports.convert import read_captures, study_of
from cell.study.imports.mapping import FILE, read_mapping
from cell.study.imports.write import write_imported, write_wide
from tests.cell.study.test_folder import same


def a_study() -> Study:
    """Of a rig in a level plane, with a connector and markers put on by hand; trials differ."""
    rng = np.random.default_rng(3)
    t_s = np.arange(0.0, 0.4, 0.01)
    swing = 0.01 * np.sin(20.0 * t_s)[:, None, None] * np.array([0.9, 0.5, 0.1])[:, None]
    xy_m = np.array([[-0.11, 0.0], [-0.06, 0.0], [-0.01, 0.0]]) + swing * [0.0, 1.0]
    xy_m += 1e-5 * rng.normal(size=xy_m.shape)
    hand = Motion(t_s + 1e-3, *(1e-5 * rng.normal(size=(2, len(t_s)))), 0.0 * t_s)
    drift = HandDrift(0.1, 1.0 / 3.0, (1e-3, 0.0), 0.01, ends_known=True)
    trials = (
        Trial("one", "fit", "moving", hand, Markers(t_s, xy_m), hand_drift=drift),
        Trial("two", "validate", "held", hand, Markers(t_s[5:], xy_m[5:]), 0.07),
    )
    cable = Cable(0.1, 0.0074, 0.016, 1e-4, Connector(0.002, 0.02, 1.1e-7))
    return Study("rig", cable, np.array([0.113, 0.061, 0.012]), trials, (0.0, 0.0), 1.3e-5,
                 arc_length_std_m=np.array([3e-4, 0.0, 1e-3 / 3.0]))  # fmt: skip


def test_all_that_a_study_says_comes_back(tmp_path: Path) -> None:
    study = a_study()
    write_wide(study, tmp_path / "tables")
    read = read_mapping(tmp_path / "tables" / FILE)
    again = study_of(read, read_captures(read)).study
    same(again, study)
    write_imported(again, tmp_path / "study")
    same(read_study(tmp_path / "study"), study)


def test_markers_whose_arc_length_is_exact_need_not_say_so(tmp_path: Path) -> None:
    study = replace(a_study(), arc_length_std_m=None)
    write_wide(study, tmp_path)
    assert "arc_length_std_m" not in (tmp_path / FILE).read_text()
    read = read_mapping(tmp_path / FILE)
    same(study_of(read, read_captures(read)).study, study)


def test_a_frame_in_which_no_marker_was_seen_comes_back(tmp_path: Path) -> None:
    study = a_study()
    first, second = study.trials
    lost_m = second.markers.xy_m.copy()
    lost_m[[0, 7, -1]] = np.nan  # the gripper's log has times of its own
    hand = replace(second.grip, t_s=second.grip.t_s - 1e-3)  # and here those of the frames
    second = replace(second, grip=hand, markers=Markers(second.markers.t_s, lost_m))
    study = replace(study, trials=(first, second))
    write_wide(study, tmp_path)
    read = read_mapping(tmp_path / FILE)
    same(study_of(read, read_captures(read)).study, study)


def test_a_wrench_comes_back_where_a_trial_has_one(tmp_path: Path) -> None:
    study = a_study()
    first, second = study.trials
    rng = np.random.default_rng(5)
    rows_s = np.arange(0.003, 0.36, 1.0 / 700.0)
    values = rng.normal(size=(len(rows_s), 3)) * [0.3, 0.3, 0.02] + [0.0, 1.0, 0.0]
    values[:, 0] = np.nan
    values[7, 2] = np.nan
    first = replace(first, wrench=Wrench(rows_s, values))
    tool = Tool(0.02, (0.03, 0.0), 1e-5)
    sensor = WrenchSensor(Gauge(tool, turns=True), moment_std_nm=1e-3 / 3.0, gain_std=0.01)
    study = replace(study, trials=(first, second), sensor=sensor)
    write_wide(study, tmp_path / "tables")
    read = read_mapping(tmp_path / "tables" / FILE)
    again = study_of(read, read_captures(read)).study
    assert "force_x_n" not in (tmp_path / "tables" / "one.csv").read_text()
    write_imported(again, tmp_path / "study")
    for back in (again, read_study(tmp_path / "study")):
        same(back, study)
        assert back.sensor == sensor
        np.testing.assert_array_equal(back.trials[0].wrench.t_s, rows_s)
        np.testing.assert_array_equal(back.trials[0].wrench.values, values)
        assert back.trials[1].wrench is None


def test_a_section_of_a_wrench_without_columns_is_refused(tmp_path: Path) -> None:
    write_wide(a_study(), tmp_path)
    mapping = tmp_path / FILE
    mapping.write_text(mapping.read_text() + "wrench: {columns: [null, null, null]}\n")
    with pytest.raises(InputError, match=r"wrench\.columns: are all null; name one"):
        read_mapping(mapping)
