from dataclasses import replace

import numpy as np
import pytest

from cell.cable.geometry import Motion
from cell.identify.noise import Noise, across, estimate_noise, still_frames
from cell.identify.whitener import Sensors, Whitener
from tools.worlds.made_studies import coloured

BASE_M = np.stack([np.linspace(-0.1, 0.0, 11), np.linspace(-0.03, 0.0, 11)], axis=-1)


def ar1(rng: np.random.Generator, colour: float, frames: int) -> np.ndarray:
    return coloured(rng, (frames, 11, 2), colour)


@pytest.mark.parametrize("colour", [0.0, 0.4, 0.8])
def test_estimate_is_unbiased(colour: float) -> None:
    rng = np.random.default_rng(1)
    estimates = [estimate_noise([BASE_M + 1e-4 * ar1(rng, colour, 40)]) for _ in range(40)]
    std, found = np.mean([e for e in estimates if e is not None], axis=0)
    assert std == pytest.approx(1e-4, rel=0.02)
    assert found == pytest.approx(colour, abs=0.03)


def test_estimate_skips_unseen_markers_and_refuses_short_records() -> None:
    markers = BASE_M + 1e-4 * ar1(np.random.default_rng(2), 0.0, 40)
    markers[:, 3] = np.nan
    markers[::3] = np.nan
    estimate = estimate_noise([markers])
    assert estimate is not None
    assert estimate[0] == pytest.approx(1e-4, rel=0.1)
    assert estimate_noise([markers[:6]]) is None
    assert estimate_noise([]) is None


@pytest.mark.parametrize("across_only", [False, True])
@pytest.mark.parametrize("colour", [0.0, 0.7])
def test_whitened_noise_is_white_and_of_unit_size(colour: float, across_only: bool) -> None:
    rng = np.random.default_rng(3)
    error = 1e-4 * ar1(rng, colour, 400) + 3e-5 * rng.normal(size=(11, 2))
    measured = BASE_M + error
    measured[rng.random((400, 11)) < 0.2] = np.nan
    whitener = Whitener(measured, Noise(1e-4, colour, 3e-5, across_only))
    white = whitener(np.broadcast_to(BASE_M, (1, 400, 11, 2)).copy())[0]
    assert whitener.count == np.isfinite(measured).sum() / (2 if across_only else 1)
    assert white @ white / whitener.count == pytest.approx(1.0, abs=0.06)
    pairs = white.reshape(-1, 400)
    assert np.mean(pairs[:, 1:] * pairs[:, :-1]) == pytest.approx(0.0, abs=0.05)


def test_whitening_equals_the_dense_covariance() -> None:
    """|white|² is eᵀ C⁻¹ e of the covariance that the class promises."""
    rng = np.random.default_rng(4)
    frames, noise = 12, Noise(1e-4, 0.6, 2e-4)
    measured = rng.normal(size=(frames, 1, 2))
    measured[[3, 4, 9]] = np.nan
    seen = np.isfinite(measured[:, 0, 0])
    error = 1e-4 * rng.normal(size=(frames, 2))
    predicted = np.nan_to_num(measured) - error[:, None]
    white = Whitener(measured, noise)(predicted[None])[0].reshape(2, frames)
    frame = np.arange(frames)[seen]
    dense = noise.std_m**2 * noise.ar1 ** np.abs(frame[:, None] - frame) + noise.bias_m**2
    for channel in (0, 1):
        e = error[seen, channel]
        expected = e @ np.linalg.solve(dense, e)
        assert white[channel] @ white[channel] == pytest.approx(expected, rel=1e-9)


def test_errors_along_the_cable_do_not_count_across_it() -> None:
    turned = np.linspace(0.0, 0.5, 30)[:, None]
    s = np.linspace(0.1, 0.0, 11)
    line = np.stack([-s * np.cos(turned), -s * np.sin(turned)], axis=-1)
    along = np.stack([-np.cos(turned), -np.sin(turned)], axis=-1)
    up = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    whitener = Whitener(line, Noise(1e-4, across_only=True))
    white = whitener(np.stack([line - 1e-3 * along, line - 1e-4 * up]))
    np.testing.assert_allclose(white[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(white[1]), 1.0, rtol=1e-9)


@pytest.mark.parametrize("across_only", [False, True])
def test_errors_come_back_from_white_residuals(across_only: bool) -> None:
    rng = np.random.default_rng(5)
    error = 1e-4 * ar1(rng, 0.5, 50)
    measured = BASE_M + error
    measured[10:13, 4] = np.nan
    whitener = Whitener(measured, Noise(1e-4, 0.5, 1e-5, across_only))
    back = whitener.error_m(whitener(np.broadcast_to(BASE_M, (1, 50, 11, 2)).copy())[0])
    np.testing.assert_array_equal(np.isnan(back[..., 0]), np.isnan(measured[..., 0]))
    expected = measured - BASE_M
    if across_only:
        expected = np.sum(expected * across(measured), axis=-1, keepdims=True)
    np.testing.assert_allclose(back, expected, atol=1e-15)


def test_still_frames_end_before_the_hand_moves() -> None:
    t = np.arange(0.0, 1.0, 0.002)
    y = np.where(t < 0.2, 0.0, -(t - 0.2))
    grip = Motion(t, 0.0 * t, y, 0.0 * t)
    frames = np.arange(0.0, 1.0, 0.005)
    still = frames[still_frames(frames, grip)]
    assert still[-1] == pytest.approx(0.19, abs=0.006)
    assert len(frames[still_frames(frames, grip, release_s=0.1)]) == 20


@pytest.mark.parametrize(
    "values", [(0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0), (1e-4, 1.0, 0.0), (1e-4, 0.0, -1e-6)]
)
def test_impossible_noise_is_refused(values: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="noise"):
        Noise(values[0], values[1], values[2])


@pytest.mark.parametrize("white", [0.2, 0.8])
def test_coloured_noise_beside_white_equals_the_dense_covariance(white: float) -> None:
    rng = np.random.default_rng(4)
    seen_m = rng.normal(size=(50, 3, 2))
    seen_m[7, 1] = seen_m[20:24, 2] = seen_m[0, 0] = np.nan
    noise = Noise(2.0, 0.7, 0.5, white=white)
    whitener = Whitener(seen_m, noise)
    rows = whitener(np.zeros((1, *seen_m.shape)))[0]
    for marker, series in enumerate(rows.reshape(3, 2, 50)[:, 0]):
        t = np.flatnonzero(np.isfinite(seen_m[:, marker, 0]))
        x = seen_m[t, marker, 0]
        of_time = (1.0 - white) * 0.7 ** np.abs(t[:, None] - t) + white * np.eye(len(t))
        covariance = 4.0 * of_time + 0.25
        assert series @ series == pytest.approx(x @ np.linalg.solve(covariance, x))
    back = whitener.error_m(rows)
    assert np.nanmax(np.abs(back - seen_m)) < 1e-12
    assert np.array_equal(np.isnan(back), np.isnan(seen_m))


def test_a_white_share_counts_as_independent() -> None:
    assert Noise(1.0, 0.5).effective_fraction == pytest.approx(1.0 / 3.0)
    assert Noise(1.0, 0.5, white=0.5).effective_fraction == pytest.approx(0.5)
    with pytest.raises(ValueError, match="white"):
        Noise(1.0, 0.5, white=1.0)


def sensed(rng, colour=0.6, tare=0.3, gain=1.0):
    """A marker and a sensor's two points, the last coordinate never seen; what is without error.

    The sensor has rows of its own between the marker's.
    """
    t = np.arange(600)
    clean = np.stack([np.sin(t / k) for k in (30.0, 50.0, 37.0, 60.0, 80.0, 1.0)], 1)
    clean = 1e-2 * clean.reshape(600, 3, 2)
    frames, rows = t % 2 == 0, t % 3 == 0
    measured = clean.copy()
    measured[:, 1:] *= gain
    measured[:, 1:] += tare * rng.normal(size=(2, 2))
    noise = rng.normal(size=(600, 3, 2))
    for marker, own, c in ((0, frames, 0.0), (1, rows, colour), (2, rows, colour)):
        series = noise[own, marker]
        for k in range(1, len(series)):
            series[k] = c * series[k - 1] + np.sqrt(1.0 - c**2) * series[k]
        measured[own, marker] += 1e-4 * series
        measured[~own, marker] = np.nan
    measured[:, 2, 1] = np.nan
    noises = (Noise(1e-4, colour, bias_m=1.0),) * 2
    return measured, clean, Sensors(noises, 0.02, frames, rows)


def test_tare_and_gain_of_a_sensor_are_no_error():
    measured, clean, sensors = sensed(np.random.default_rng(5), gain=1.1)
    sensors = replace(sensors, gain_std=0.1)
    whitener = Whitener(measured, Noise(1e-4), sensors=sensors)
    white = whitener(clean[None])[0]
    assert whitener.count == 2 * 300 + 3 * 200 - 3
    assert white @ white / whitener.count == pytest.approx(1.0, abs=0.1)
    error = whitener.residual_m(clean)
    np.testing.assert_allclose(whitener.error_m(white)[:, 1:], error[:, 1:])
    assert np.nanstd(error[:, 1:]) == pytest.approx(1e-4, rel=0.15)
    assert abs(np.nanmean(error[:, 1:])) < 3e-5
    certain = Whitener(measured, Noise(1e-4), sensors=replace(sensors, gain_std=0.0))
    white = certain(clean[None])[0]
    assert white @ white / whitener.count > 2.0


def test_an_uncertain_gain_makes_no_force_look_too_small():
    """Of a wrench as large as its noise, whose gain takes a share of what a model says of it.

    Of the measured wrench instead it takes a share of the noise too, which looks like a weaker one.
    """
    told, measured_itself = [], []
    for number in range(40):
        _, clean, sensors = sensed(np.random.default_rng(number))
        noise = np.random.default_rng(1000 + number).normal(size=clean.shape)
        sensors = replace(sensors, gain_std=0.5, noises=(Noise(1e-2, bias_m=100.0),) * 2)
        measured = clean + np.array([1e-4, 1e-2, 1e-2])[:, None] * noise
        measured[~sensors.rows, 1:] = np.nan
        measured[:, 2, 1] = np.nan
        along = clean - clean[sensors.rows].mean(axis=0)
        for found, shown in ((told, clean[:, 1:]), (measured_itself, None)):
            whitener = Whitener(measured, Noise(1e-4), sensors=replace(sensors, shown_m=shown))
            white = whitener(clean[None])[0].reshape(3, 2, 600)
            found.append(np.sum((white * along.transpose(1, 2, 0))[1:][:, :, sensors.rows]))
    size = np.std(told) / np.sqrt(len(told))
    assert abs(np.mean(told)) < 3.0 * size
    assert np.mean(measured_itself) < -5.0 * size


def test_a_sensors_rows_have_the_colour_that_they_have_among_themselves():
    measured, clean, sensors = sensed(np.random.default_rng(6))
    whitener = Whitener(measured, Noise(1e-4), sensors=sensors)
    white = whitener(clean[None])[0].reshape(3, 2, 600)
    for series in (white[1, 0], white[1, 1], white[2, 0]):
        own = series[sensors.rows]
        assert np.mean(own[1:] * own[:-1]) == pytest.approx(0.0, abs=0.2)
        assert np.all(series[~sensors.rows] == 0.0)


def test_smooth_functions_of_a_sensor_are_its_own():
    """Of each marker by itself, and orthonormal: a misfit of a force is no polynomial of places."""
    measured, _, sensors = sensed(np.random.default_rng(7))
    x, y = Whitener(measured, Noise(1e-4), sensors=sensors).smooth_modes
    for modes in (x, y):
        np.testing.assert_allclose(modes.T @ modes, np.eye(modes.shape[1]), atol=1e-9)
    by_marker = (x.reshape(3, 600, -1) ** 2).sum(axis=1) > 1e-12
    assert np.all(by_marker.sum(axis=0) == 1)
    assert np.all(y.reshape(3, 600, -1)[2] == 0.0)
