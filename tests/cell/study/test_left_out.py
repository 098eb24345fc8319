"""What is left out of a study is told with its place; too much of it is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.cable.geometry import Cable, Motion
from cell.files.input_error import InputError
from cell.study.data import Markers, Study, Trial
from cell.study.folder import read_study, write_study
from cell.study.left_out import without_wrong_samples


@pytest.fixture
def study() -> Study:
    """A cable at rest, seen with noise in 200 frames; listed from the hand on."""
    t_s = np.arange(200) / 100.0
    still = np.zeros(200)
    arcs = np.array([0.1, 0.05])
    xy_m = np.stack([-arcs, -0.2 * arcs], axis=-1) + np.zeros((200, 2, 2))
    xy_m += np.random.default_rng(1).normal(0.0, 1e-4, xy_m.shape)
    trial = Trial("a", "fit", "equilibrium", Motion(t_s, still, still, still), Markers(t_s, xy_m))
    return Study("s", Cable(0.1, 0.0074, 0.016, 1e-4), arcs, (trial,))


def spoilt(study: Study, rows: list[int], folder: Path) -> Study:
    study.trials[0].markers.xy_m[rows, 1, 0] += 0.03
    write_study(study, folder)
    path = folder / "a" / "markers.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], "", *lines[1:]]) + "\n")  # a blank line shifts all others
    return read_study(folder)


def test_a_wrong_value_is_left_out_and_told_with_line_column_and_size(study, tmp_path):
    read = spoilt(study, [150], tmp_path)
    left = without_wrong_samples(read)
    expected = read.trials[0].markers.xy_m.copy()
    expected[150, 1, 0] = np.nan
    assert np.array_equal(left.trials[0].markers.xy_m, expected, equal_nan=True)
    assert left.notes == (
        f"{tmp_path}/a/markers.csv: 1 value lies apart from the rows before and after, as no cable "
        "does: line 153, x1_m by +30 mm; left out",
    )


def test_nothing_is_told_of_a_study_in_which_nothing_is_wrong(study):
    assert without_wrong_samples(study).trials == study.trials
    assert without_wrong_samples(study).notes == ()


def test_of_a_marker_two_in_a_hundred_rows_may_be_wrong(study, tmp_path):
    left = without_wrong_samples(spoilt(study, [20, 70, 120, 170], tmp_path / "four"))
    assert np.isnan(left.trials[0].markers.xy_m).sum() == 4
    assert "4 values lie apart" in left.notes[0] and "and 1 more lines" in left.notes[0]


def test_more_are_refused(study, tmp_path):
    with pytest.raises(InputError) as caught:
        without_wrong_samples(spoilt(study, [20, 60, 100, 140, 180], tmp_path))
    assert str(caught.value).startswith(f"{tmp_path}/a/markers.csv:23: x1_m: -0.0")
    assert "as do 5 of this marker's 200 rows; limit 2%: mend" in str(caught.value)


@pytest.mark.parametrize(("wrong", "refused"), [([20, 45, 70], False), ([15, 35, 55, 75], True)])
def test_of_a_short_trial_three_rows_may_be_wrong(study, wrong, refused):
    (trial,) = study.trials
    cut = Markers(trial.markers.t_s[:88], trial.markers.xy_m[:88].copy())
    cut.xy_m[wrong, 1, 0] += 0.03
    short = replace(study, trials=(replace(trial, markers=cut),))
    if refused:
        with pytest.raises(InputError, match="as do 4 of this marker's 88 rows; limit 3: mend"):
            without_wrong_samples(short)
    else:
        assert np.isnan(without_wrong_samples(short).trials[0].markers.xy_m).sum() == 3


def test_how_far_along_the_cable_filmed_nodes_are_may_be_wrong_in_any_row(study):
    """The end of a centre line is found late or early where it is thin: no measurement is lost."""
    away_m = np.array([0.03, 0.006])  # along the cable
    study.trials[0].markers.xy_m[20:200:15, 1] += away_m
    with pytest.raises(InputError, match="as do 12 of this marker's 200 rows"):
        without_wrong_samples(study)
    left = without_wrong_samples(replace(study, filmed=True))
    assert np.isnan(left.trials[0].markers.xy_m[:, 1, 0]).sum() == 12


def test_across_the_cable_filmed_nodes_are_refused_like_any_other(study):
    study.trials[0].markers.xy_m[20:200:15, 1] += [-0.006, 0.03]
    with pytest.raises(InputError, match="as do 12 of this marker's 200 rows"):
        without_wrong_samples(replace(study, filmed=True))
