"""Where a model fails: planted patterns are found, white noise is left alone."""

import numpy as np
import pytest

from cell.identify.noise import Noise, rms
from cell.lab.fit.series import ljung_box, lomb_scargle, smoothed, spectrum
from cell.lab.strength.compare import PHASES, across_tip, phase_of, trial_residual


def test_ljung_box_tells_white_from_coloured():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(300, 6))
    p = [ljung_box(rng.normal(size=(300, 6))) for _ in range(40)]
    assert 0.3 < np.mean(p) < 0.7
    assert ljung_box(white[1:] + 0.4 * white[:-1]) < 1e-6
    white[5:9] = np.nan
    assert ljung_box(white) > 1e-3


def test_the_spectrum_of_noise_is_the_noise_floor():
    rng = np.random.default_rng(1)
    noise = Noise(1e-4, 0.6)
    series = rng.normal(size=(1200, 20, 2))
    for i in range(1, len(series)):
        series[i] = 0.6 * series[i - 1] + 0.8 * series[i]
    found = spectrum(np.arange(1200) * 0.005, 1e-4 * series, noise)
    low, high = found.frequency_hz < 10.0, found.frequency_hz > 80.0
    for part in (low, high):
        assert found.residual_m2_per_hz[part].mean() == pytest.approx(
            found.noise_m2_per_hz[part].mean(), rel=0.1
        )


def test_a_late_error_at_the_tip_is_placed(make_study):
    study = make_study(ar1=0.0, hold_s=0.4)
    trial = study.trials[0]
    predicted = trial.markers.xy_m.copy()
    late = phase_of(trial) == "late swing"
    predicted[late, 0, 1] += 1e-3
    white = (trial.markers.xy_m - predicted) / 1e-4
    found = trial_residual(
        trial, predicted, trial.markers.xy_m - predicted, white, study.arc_length_m, Noise(1e-4)
    )
    assert max(found.by_phase, key=lambda p: found.by_phase[p]) == "late swing"
    assert int(np.argmax(found.by_arc_length.rms_m)) == 0
    assert found.by_phase["still"] == 0.0
    assert found.whiteness_p_value < 1e-6


def test_phases_follow_the_hand(make_study):
    trial = make_study(hold_s=0.8).trials[0]
    names = phase_of(trial)
    assert [names[np.searchsorted(trial.markers.t_s, t)] for t in (0.1, 0.35, 0.6, 1.0)] == list(
        PHASES
    )


def test_an_error_that_follows_the_tip_velocity_is_named(make_study):
    study = make_study(ar1=0.0)
    trial = study.trials[0]
    seen = trial.markers.xy_m
    velocity = np.gradient(seen[:, 0], trial.markers.t_s, axis=0)
    white = np.random.default_rng(0).normal(size=seen.shape)
    white[:, 0] += 20.0 * velocity
    found = trial_residual(
        trial, seen, trial.markers.xy_m - seen, white, study.arc_length_m, Noise(1e-4)
    ).correlations
    assert {f.signal for f in found[:3]} >= {"tip velocity"}
    assert found[0].p_value < 1e-4


def test_rms_ignores_what_was_not_seen():
    assert rms(np.array([3.0, np.nan, -3.0])) == 3.0
    assert np.isnan(rms(np.array([np.nan])))


@pytest.mark.parametrize("markers", [1, 11])
def test_across_the_tip_is_square_to_the_cable(make_study, markers):
    trial = make_study(seed=1).trials[0]
    across = across_tip(trial, trial.markers.xy_m[:, :markers])
    assert np.linalg.norm(across, axis=1) == pytest.approx(1.0)
    # level clamp, drooping cable: its tip points left and down, hence across it is down and right
    assert (across[:30, 1] < -0.5).all()


def test_no_frequency_is_at_nyquist_where_half_the_power_is_lost():
    found = spectrum(np.arange(400) * 0.005, np.ones((400, 3, 2)), Noise(1e-4))
    assert 99.0 < found.frequency_hz[-1] < 100.0


def test_periodogram_and_smoothing_are_those_of_scipy():
    """Which takes half a second to import."""
    signal = pytest.importorskip("scipy.signal")
    rng = np.random.default_rng(3)
    t_s, frequency = np.sort(rng.uniform(0.0, 1.5, 300)), np.linspace(0.7, 90.0, 40)
    values = rng.normal(size=(300, 3))
    theirs = [signal.lombscargle(t_s, v, 2.0 * np.pi * frequency) for v in values.T]
    np.testing.assert_allclose(
        lomb_scargle(t_s, values, frequency), np.transpose(theirs), rtol=1e-9
    )
    for window in (11, 5):
        theirs = signal.savgol_filter(values, window, 3, axis=0)
        np.testing.assert_allclose(smoothed(values, window), theirs, atol=1e-12)
