"""Wrong samples are found and right ones are kept, over what users bring."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.cable.dynamics import simulate
from cell.cable.geometry import Cable, Motion
from cell.cable.model import CableModel
from cell.study.folder import read_study
from cell.study.wrong_samples import wrong_samples

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
        assert np.isnan(wrong_samples(*measured)).all()


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
        wrong = wrong_samples(t_s, left_m)
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
    wrong = wrong_samples(t_s, one)
    assert np.argwhere(np.isfinite(wrong)).tolist() == [[row, 6]]
    assert wrong[row, 6] == pytest.approx(0.03, abs=2e-3)
    wrong = wrong_samples(t_s, whole)
    assert np.flatnonzero(np.isfinite(wrong).all(axis=1)).tolist() == [row]
    assert np.isfinite(wrong).sum() == 22


def test_three_in_a_row_are_found(swing):
    t_s, series_m = seen(swing, np.random.default_rng(5), 5, 1e-4)
    series_m[100:103, 4] += 0.02
    wrong = np.argwhere(np.isfinite(wrong_samples(t_s, series_m)))
    assert wrong.tolist() == [[100, 4], [101, 4], [102, 4]]


def test_a_step_is_no_wrong_sample(swing):
    """From there on everything is elsewhere: a slip of the grip, which is for others to judge."""
    t_s, series_m = seen(swing, np.random.default_rng(6), 5, 1e-4)
    series_m[130:] += 0.01
    assert np.isnan(wrong_samples(t_s, series_m)).all()


@pytest.mark.skipif(not SHARED.exists(), reason="shared measurements are not beside the project")
def test_of_the_real_studies_no_sample_is_taken_for_wrong():
    for folder in (SHARED / "real").glob("*/study.yaml"):
        for trial in read_study(folder.parent).trials:
            t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
            assert np.isnan(wrong_samples(t_s, xy_m.reshape(len(t_s), -1))).all()
