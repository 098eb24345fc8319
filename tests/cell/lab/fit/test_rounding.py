"""What rounding adds on average is taken out, so that it is not taken for a misfit."""

import numpy as np
import pytest

from cell.lab.data.prepared import as_measured
from cell.lab.diagnosis import diagnose
from cell.lab.fit.corrections import mean_rounding_error, rounding_error_m, without_rounding_error
from tests.cell.lab.conftest import fits_of, rounded

NOISE_M = 2e-5


@pytest.mark.parametrize("std", [0.0, 0.05, 0.125, 0.3, 1.0])
def test_the_mean_error_is_that_of_many_rounded_values(std):
    rng, place = np.random.default_rng(0), np.array([-3.4, -0.2, 0.0, 0.31, 0.49, 7.62])
    values = place + std * rng.normal(size=(200_000, len(place)))
    error = np.round(values).mean(axis=0) - place
    found = mean_rounding_error(place, np.full(len(place), std))
    np.testing.assert_allclose(found, error, atol=5.0 * max(std, 0.3) / np.sqrt(200_000))


def test_noise_as_large_as_a_step_hides_it():
    place = np.linspace(-1.0, 1.0, 41)
    for std in (1.0, 30.0):
        assert np.abs(mean_rounding_error(place, np.full(41, std))).max() < 1e-8


@pytest.mark.usefixtures("own_mesh")
@pytest.mark.parametrize("origin_m", [0.0, 3.1e-5])
def test_most_of_the_error_is_found_beside_a_fitted_model(make_study, origin_m):
    clean, seen = (make_study(seed=5, noise_m=noise_m, hold_s=0.4) for noise_m in (1e-12, NOISE_M))
    made = rounded(seen, 8.0 * NOISE_M, origin_m)
    fits = fits_of(made)
    fit, prepared = fits.base.fit, fits.prepared
    for before, after, without in zip(
        made.trials, prepared.study.trials, clean.trials, strict=True
    ):
        error, left = (
            t.markers.xy_m[:12] - without.markers.xy_m[:12] for t in (before, after)
        )  # at rest: the same in all frames
        assert np.abs(left.mean(axis=0)).mean() < 0.5 * np.abs(error.mean(axis=0)).mean()
    again = rounding_error_m(prepared, fit)
    assert max(np.abs(e).max() for e in again.values()) < 2.0 * NOISE_M
    for before, after in zip(made.trials, as_measured(prepared).trials, strict=True):
        np.testing.assert_allclose(after.markers.xy_m, before.markers.xy_m, atol=1e-12)


def test_a_study_that_is_not_rounded_stays_as_it_is(make_study):
    made = make_study(seed=5, noise_m=NOISE_M)
    fits = fits_of(made)
    prepared = fits.prepared
    found = rounding_error_m(prepared, fits.base.fit)
    assert found == {}
    assert without_rounding_error(prepared, found) is prepared


@pytest.mark.parametrize("seed", range(4))
def test_values_rounded_to_eight_times_their_noise_are_no_misfit(make_study, seed):
    made = rounded(make_study(seed=seed, noise_m=NOISE_M), 8.0 * NOISE_M)
    names = ("air_drag", "tip_mass", "draught", "natural_curvature")
    assert diagnose(fits_of(made, names)).diagnosis.verdict == "complete"
