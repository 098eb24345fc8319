"""Wrong samples are found and right ones are kept, over what users bring."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.files.input_error import InputError
from cell.study.data import Markers, Study, Trial
from cell.study.folder import read_study, write_study
from cell.study.left_out import without_outliers
from cell.study.sample_outliers import outlier_distances

SHARED = Path(__file__).parents[4] / "shared" / "data"
LENGTH_M = 0.1


@pytest.fixture(scope="module")
def swing() -> tuple[np.ndarray, np.ndarray]:
    """Times, 1000 a second, and places of eleven markers of a soft cable that is jerked."""
    t = np.arange(0.0, 1.3, 0.002)
    u = np.clip((t - 0.2) / 0.2, 0.0, 1.0)
    done = u**3 * (10 - 15 * u + 6 * u**2)
    grip = Motion(t, -0.05 * done, -0.06 * done, 0.2 + 0.0 * t)
    model = CableModel.uniform(Cable(LENGTH_M, 0.0074, 0.016, 1e-4), 2e-5, viscosity_n_m2_s=1e-7)
    times = np.arange(0.0, 1.3, 0.001)
    return times, simulate(model, grip, times, np.linspace(LENGTH_M, 0.0, 11))[0]


def seen(swing, rng, every, noise_m, colour=0.0, step_m=0.0, lost=0.0):
    """The swing in one of so many frames, with noise; (T,), (T, channels)."""
    t_s, series_m = swing[0][::every], swing[1][::every]
    series_m = series_m.reshape(len(t_s), -1)
    noise = rng.normal(size=series_m.shape)
    for i in range(1, len(noise)):
        noise[i] = colour * noise[i - 1] + np.sqrt(1.0 - colour**2) * noise[i]
    series_m = series_m + noise_m * noise
    if step_m:
        series_m = np.round(series_m / step_m) * step_m
    series_m[rng.random(series_m.shape) < lost] = np.nan
    return t_s, series_m


@pytest.mark.parametrize("every", [5, 10, 33])
@pytest.mark.parametrize(("noise", "colour"), [(0.0, 0.0), (2e-4, 0.0), (5e-3, 0.7)])
def test_no_right_sample_is_taken_for_wrong(swing, every, noise, colour):
    rng = np.random.default_rng(every)
    for step, lost in ((0.0, 0.0), (2e-3, 0.02)):
        measured = seen(swing, rng, every, noise * LENGTH_M, colour, step * LENGTH_M, lost)
        assert np.isnan(outlier_distances(*measured)).all()


@pytest.mark.parametrize("colour", [0.0, 0.7])
def test_of_samples_ten_times_the_noise_off_nearly_all_are_found(swing, colour):
    """In what a right model leaves of them: noise alone."""
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(20):
        t_s = np.arange(120) / 60.0
        left_m = seen((t_s, np.zeros((120, 2, 2))), rng, 1, 1e-4, colour)[1]
        row, channel = rng.integers(120), rng.integers(4)
        left_m[row, channel] += 10e-4
        wrong = outlier_distances(t_s, left_m)
        found += np.isfinite(wrong[row, channel])
        wrong[row, channel] = np.nan
        assert np.isnan(wrong).all()
    assert found >= 19


@pytest.mark.parametrize("row", [0, 41, 129])
def test_a_wrong_row_and_a_wrong_value_are_found_with_their_size(swing, row):
    rng = np.random.default_rng(row)
    t_s, series_m = seen(swing, rng, 10, 1e-4)
    one, whole = series_m.copy(), series_m.copy()
    one[row, 6] += 0.03
    whole[row] -= 0.03
    wrong = outlier_distances(t_s, one)
    assert np.argwhere(np.isfinite(wrong)).tolist() == [[row, 6]]
    assert wrong[row, 6] == pytest.approx(0.03, abs=2e-3)
    wrong = outlier_distances(t_s, whole)
    assert np.flatnonzero(np.isfinite(wrong).all(axis=1)).tolist() == [row]
    assert np.isfinite(wrong).sum() == 22


def test_three_in_a_row_are_found(swing):
    t_s, series_m = seen(swing, np.random.default_rng(5), 5, 1e-4)
    series_m[100:103, 4] += 0.02
    wrong = np.argwhere(np.isfinite(outlier_distances(t_s, series_m)))
    assert wrong.tolist() == [[100, 4], [101, 4], [102, 4]]


def test_a_step_is_no_wrong_sample(swing):
    """From there on everything is elsewhere: a slip of the grip, which is for others to judge."""
    t_s, series_m = seen(swing, np.random.default_rng(6), 5, 1e-4)
    series_m[130:] += 0.01
    assert np.isnan(outlier_distances(t_s, series_m)).all()


@pytest.mark.skipif(not SHARED.exists(), reason="shared measurements are not beside the project")
def test_of_the_real_studies_no_sample_is_taken_for_wrong():
    for folder in (SHARED / "real").glob("*/study.yaml"):
        for trial in read_study(folder.parent).trials:
            t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
            assert np.isnan(outlier_distances(t_s, xy_m.reshape(len(t_s), -1))).all()


@pytest.fixture
def study() -> Study:
    """A cable at rest, seen with noise in 200 frames; listed from the gripper on."""
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
    left = without_outliers(read)
    expected = read.trials[0].markers.xy_m.copy()
    expected[150, 1, 0] = np.nan
    assert np.array_equal(left.trials[0].markers.xy_m, expected, equal_nan=True)
    assert left.notes == (
        f"{tmp_path}/a/markers.csv: 1 value lies apart from the rows before and after, as no cable "
        "does: line 153, x1_m by +30 mm; left out",
    )


def test_nothing_is_told_of_a_study_in_which_nothing_is_wrong(study):
    assert without_outliers(study).trials == study.trials
    assert without_outliers(study).notes == ()


def test_of_a_marker_two_in_a_hundred_rows_may_be_wrong(study, tmp_path):
    left = without_outliers(spoilt(study, [20, 70, 120, 170], tmp_path / "four"))
    assert np.isnan(left.trials[0].markers.xy_m).sum() == 4
    assert "4 values lie apart" in left.notes[0] and "and 1 more lines" in left.notes[0]


def test_more_are_refused(study, tmp_path):
    with pytest.raises(InputError) as caught:
        without_outliers(spoilt(study, [20, 60, 100, 140, 180], tmp_path))
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
            without_outliers(short)
    else:
        assert np.isnan(without_outliers(short).trials[0].markers.xy_m).sum() == 3


def test_how_far_along_the_cable_filmed_nodes_are_may_be_wrong_in_any_row(study):
    """The end of a centre line is found late or early where it is thin: no measurement is lost."""
    away_m = np.array([0.03, 0.006])  # along the cable
    study.trials[0].markers.xy_m[20:200:15, 1] += away_m
    with pytest.raises(InputError, match="as do 12 of this marker's 200 rows"):
        without_outliers(study)
    left = without_outliers(replace(study, filmed=True))
    assert np.isnan(left.trials[0].markers.xy_m[:, 1, 0]).sum() == 12


def test_across_the_cable_filmed_nodes_are_refused_like_any_other(study):
    study.trials[0].markers.xy_m[20:200:15, 1] += [-0.006, 0.03]
    with pytest.raises(InputError, match="as do 12 of this marker's 200 rows"):
        without_outliers(replace(study, filmed=True))
