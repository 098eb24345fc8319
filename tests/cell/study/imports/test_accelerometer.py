"""A gripper's place by its acceleration: recovered, with the uncertainty that it has, or
refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cell.study.imports.accelerometer import (
    AccelerometerSamples,
    NotIntegrableError,
    integrated,
    turned_by,
)

G = (0.0, -9.81)
LIMIT_M = 1e-4
REST_S, AFTER_S = 0.2, 0.5


def stroke(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Way from 0 to 1 of least jerk, and its second derivative."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2), 60.0 * u - 180.0 * u**2 + 120.0 * u**3


def motion(
    way_m: tuple[float, float], moved_s: float, rate_hz: float = 1000.0, turn_rad: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, path (T, 2), acceleration (T, 2), clamp angle."""
    t = np.arange(0.0, REST_S + moved_s + AFTER_S, 1.0 / rate_hz)
    done, bent = stroke((t - REST_S) / moved_s)
    path, acceleration = done[:, None] * way_m, bent[:, None] / moved_s**2 * way_m
    return t, path, acceleration, 0.3 + turn_rad * done


def sensed(
    t: np.ndarray,
    acceleration: np.ndarray,
    angle: np.ndarray,
    *,
    noise: float = 0.0,
    offset: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> AccelerometerSamples:
    """What a sensor on the clamp shows of it."""
    shown = turned_by(-angle, acceleration - G) + offset
    shown += noise * np.random.default_rng(seed).normal(size=shown.shape)
    return AccelerometerSamples(t, shown, (True, True), angle, G)


@settings(max_examples=30, deadline=None)
@given(
    st.tuples(*[st.floats(-0.3, 0.3)] * 2).filter(lambda w: np.hypot(*w) > 0.01),
    st.floats(0.15, 1.0),
    st.floats(-1.0, 1.0),
    st.tuples(*[st.floats(-0.5, 0.5)] * 2),
)
def test_any_smooth_motion_between_two_rests_is_recovered(way, moved_s, turn_rad, offset):
    """To 5e-4 of its way, whatever the sensor's offset and however the clamp turns."""
    t, path, acceleration, angle = motion(way, moved_s, turn_rad=turn_rad)
    found = integrated(sensed(t, acceleration, angle, offset=offset), 1e-3 * np.hypot(*way))
    assert np.abs(found.path_m - path).max() < 5e-4 * np.hypot(*way)


@pytest.mark.parametrize("turn_rad", [0.0, 0.8])
@pytest.mark.parametrize("moved_s", [0.2, 0.8])
def test_the_stated_uncertainty_covers(moved_s, turn_rad):
    """Of 200 sensors with noise of 0.02 m/s² the places' errors are as large as is stated."""
    t, path, acceleration, angle = motion((0.06, -0.03), moved_s, turn_rad=turn_rad)
    scores = []
    for seed in range(200):
        shown = sensed(t, acceleration, angle, noise=0.02, offset=(0.1, -0.1), seed=seed)
        found = integrated(shown, LIMIT_M)
        assert found.drift is not None
        stated_m = found.drift.largest_std_m(t, found.path_m)
        scores.append((found.path_m[-1] - path[-1]) / stated_m)
    rms = np.sqrt(np.mean(np.square(scores)))
    assert 0.75 < rms < 1.1  # noise that is slow by chance makes what is stated larger
    assert np.mean(np.abs(scores) < 1.96) > 0.93


def test_the_end_s_standard_deviation_is_that_of_the_formula():
    """σ_x² = D² T³ / 24 of white noise of one-sided density D with the velocity 0 at both ends."""
    t, _, acceleration, angle = motion((0.05, 0.0), 0.3)
    found = integrated(sensed(t, acceleration, angle, noise=0.02), LIMIT_M)
    drift = found.drift
    assert drift is not None
    density = max(drift.noise_m_per_s2_per_rt_hz)
    assert density == pytest.approx(0.02 * np.sqrt(2e-3), rel=0.25)
    wanted_m = density * np.sqrt((drift.to_s - drift.from_s) ** 3 / 24.0)
    assert drift.largest_std_m(t, found.path_m) == pytest.approx(wanted_m, rel=0.01)
    assert drift.from_s == pytest.approx(REST_S, abs=0.03)
    assert drift.to_s == pytest.approx(REST_S + 0.3, abs=0.03)


def test_a_known_end_is_met_and_leaves_less_error_on_the_way():
    t, path, acceleration, angle = motion((0.06, -0.03), 0.6)
    errors, closed = [], []
    for seed in range(40):
        shown = sensed(t, 1.01 * acceleration, 0.0 * angle, noise=0.02, seed=seed)
        errors.append(integrated(shown, LIMIT_M).path_m - path)
        known = integrated(shown, LIMIT_M, (0.06, -0.03), gain_std=0.01)
        assert known.path_m[-1] == pytest.approx((0.06, -0.03), abs=1e-9)
        closed.append(known.path_m - path)
    assert np.std(closed) < 0.35 * np.std(errors)


def test_an_axis_that_is_not_measured_does_not_move():
    t, path, acceleration, angle = motion((0.06, 0.0), 0.4)
    shown = acceleration * [1.0, 0.0]
    found = integrated(AccelerometerSamples(t, shown, (True, False), 0.0 * angle, G), LIMIT_M)
    np.testing.assert_allclose(found.path_m, path, atol=1e-5)
    assert found.drift is not None
    assert found.drift.noise_m_per_s2_per_rt_hz[1] == 0.0


def test_a_sensor_of_few_digits_rests_though_its_last_one_flickers():
    """Its drift is that of rounding: a digit of 0.04 m/s², 4 mg, hides its noise."""
    t, path, acceleration, angle = motion((0.06, -0.03), 0.4)
    shown = sensed(t, acceleration, 0.0 * angle, noise=0.006, offset=(0.018, 0.01))
    rounded = np.round(shown.specific_force / 0.04) * 0.04
    found = integrated(AccelerometerSamples(t, rounded, (True, True), 0.0 * angle, G), LIMIT_M)
    assert found.drift is not None
    assert found.drift.noise_m_per_s2_per_rt_hz[1] >= 0.04 / np.sqrt(12.0) * np.sqrt(2e-3)
    np.testing.assert_allclose(
        found.path_m, path, atol=4.0 * found.drift.largest_std_m(t, found.path_m)
    )


def test_a_hand_at_rest_stays():
    t, _, acceleration, angle = motion((0.0, 0.0), 0.4)
    found = integrated(sensed(t, acceleration, angle, noise=0.02), LIMIT_M)
    assert found.drift is None
    assert not found.path_m.any()


def late(shown: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The offset jumps while the gripper moves."""
    return shown + np.where(t[:, None] > 0.35, 0.1, 0.0)


REFUSED = {
    "no rest before": (lambda s, t: s[220:], "no rest before the motion"),
    "no rest after": (lambda s, t: s[:450], "no rest after the motion"),
    "too short": (lambda s, t: s[200:240], "limit 150"),
    "saturated": (lambda s, t: np.clip(s, -11.0, 11.0), "saturated"),
    "warming up": (lambda s, t: s + np.where(t[:, None] < 0.1, 0.5, 0.0), "motion"),
    "offset": (late, "at rest after the motion"),
    "gain": (lambda s, t: np.where((t[:, None] > 0.35) & (t[:, None] < 0.49), 1.2, 1.0)
             * (s - s[0]) + s[0], "after the motion, where it rests"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_integrated_is_refused(case):
    edit, remedy = REFUSED[case]
    t, _, acceleration, angle = motion((0.1, -0.1), 0.3)
    shown = edit(sensed(t, acceleration, angle, noise=0.002).specific_force, t)
    cut = AccelerometerSamples(t[: len(shown)], shown, (True, True), angle[: len(shown)], G)
    with pytest.raises(NotIntegrableError, match=remedy) as refusal:
        integrated(cut, LIMIT_M)
    assert 0 <= refusal.value.row < len(shown)


def test_too_few_samples_are_refused():
    t, _, acceleration, angle = motion((0.3, -0.1), 0.1, rate_hz=100.0)
    with pytest.raises(NotIntegrableError, match="take a higher rate"):
        integrated(sensed(t, acceleration, angle), LIMIT_M)


def test_a_gap_in_the_motion_is_refused():
    t, _, acceleration, angle = motion((0.1, -0.1), 0.3)
    whole = sensed(t, acceleration, angle, noise=0.002)
    kept = (t < 0.3) | (t > 0.31)
    with pytest.raises(NotIntegrableError, match="without gaps"):
        integrated(
            AccelerometerSamples(t[kept], whole.specific_force[kept], (True, True), angle[kept], G),
            LIMIT_M,
        )


def test_a_wrong_end_is_refused():
    t, _, acceleration, angle = motion((0.06, -0.03), 0.6)
    with pytest.raises(NotIntegrableError, match="hand_ends_at_m"):
        integrated(sensed(t, acceleration, angle, noise=0.02), LIMIT_M, (0.07, -0.03))
