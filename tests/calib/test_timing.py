"""Latency and lag apart from one motion, with intervals that hold."""

from __future__ import annotations

import numpy as np
import pytest

from calib.errors import MisfitError, OneSidedError, TooFewError
from calib.timing import arm_lag, camera_latency, lag_change, latency_change
from drivers.interfaces import Trajectory
from drivers.servo import servo_response


def sway(amplitude_m=0.03, hz=1.2, lasts_s=1.6, rate_hz=500.0):
    """A sinusoid that begins and ends gently."""
    t = np.arange(0.0, lasts_s, 1.0 / rate_hz)
    envelope = np.sin(np.pi * t / lasts_s) ** 2
    y = amplitude_m * envelope * np.sin(2 * np.pi * hz * t)
    return Trajectory(5.0 + t, 0.4 * y, y, np.zeros(len(t)))


def measured(rng, latency_s, lag_s, *, frames_hz=200.0, noise_m=4e-6):
    told = sway()
    true = servo_response(told, lag_s)
    t_s = np.arange(4.8, true.t_s[-1] + 0.1, 1 / 500.0)
    axes = [
        np.interp(t_s, true.t_s, v) + rng.normal(0, 1e-5, len(t_s)) for v in (true.x_m, true.y_m)
    ]
    hand = Trajectory(t_s, *axes, np.zeros(len(t_s)))
    exposed_s = np.arange(5.0, true.t_s[-1], 1 / frames_hz)
    seen = np.stack([np.interp(exposed_s, true.t_s, v) for v in (true.x_m, true.y_m)], axis=1)
    seen += np.array([2e-4, -1e-4]) + rng.normal(0, noise_m, seen.shape)
    return told, hand, exposed_s + latency_s, seen


def test_latency_and_lag_are_found_apart_and_their_intervals_hold():
    rng = np.random.default_rng(7)
    late, lag = [], []
    for _ in range(40):
        latency_s, lag_s = rng.uniform(0.0, 0.3), rng.uniform(0.005, 0.06)
        told, hand, stamps_s, seen = measured(rng, latency_s, lag_s)
        a, b = camera_latency(stamps_s, seen, hand), arm_lag(told, hand)
        assert a.value_s == pytest.approx(latency_s, abs=3e-4)
        assert b.value_s == pytest.approx(lag_s, abs=1e-3)
        late.append(abs(a.value_s - latency_s) <= a.half_width_s)
        lag.append(abs(b.value_s - lag_s) <= b.half_width_s)
    assert 34 <= sum(late) <= 40
    assert 34 <= sum(lag) <= 40


@pytest.mark.parametrize("changed_s", [0.0, 0.003, -0.002, 0.06])
def test_what_changed_since_is_found_without_a_search(changed_s):
    rng = np.random.default_rng(8)
    told, hand, stamps_s, seen = measured(rng, changed_s, 0.03 + abs(changed_s))
    late, lag = latency_change(stamps_s, seen, hand), lag_change(told, hand, 0.03)
    assert late.value_s == pytest.approx(changed_s, abs=2e-4)
    assert lag.value_s == pytest.approx(abs(changed_s), abs=2e-4)
    assert abs(late.value_s - changed_s) <= 2.0 * late.half_width_s < 4e-4


def test_a_camera_that_stamps_early_has_a_negative_latency():
    _, hand, stamps_s, seen = measured(np.random.default_rng(1), -0.02, 0.03)
    assert camera_latency(stamps_s, seen, hand).value_s == pytest.approx(-0.02, abs=3e-4)


def test_what_says_nothing_about_time_is_named():
    rng = np.random.default_rng(2)
    told, hand, stamps_s, seen = measured(rng, 0.02, 0.03)
    with pytest.raises(TooFewError, match="found in 10 of at least 30 frames"):
        camera_latency(stamps_s[:10], seen[:10], hand)
    hidden = seen.copy()
    hidden[20:] = np.nan
    with pytest.raises(TooFewError, match="found in 20 of at least 30 frames"):
        camera_latency(stamps_s, hidden, hand)
    still = Trajectory(hand.t_s, 0 * hand.t_s, 0 * hand.t_s, 0 * hand.t_s)
    with pytest.raises(OneSidedError, match="at most"):
        camera_latency(stamps_s, seen, still)
    with pytest.raises(MisfitError, match="camera is tight"):
        camera_latency(stamps_s, 1.1 * seen, hand)
    with pytest.raises(MisfitError, match="no delay within"):
        camera_latency(stamps_s + 3.0, seen, hand)
    with pytest.raises(OneSidedError):
        arm_lag(told, still)


@pytest.mark.parametrize("lag_s", [0.0, 0.002, 0.004])
def test_an_arm_that_hardly_lags_is_no_misfit(lag_s):
    told, hand, *_ = measured(np.random.default_rng(3), 0.0, lag_s)
    found = arm_lag(told, hand)
    assert found.value_s == pytest.approx(lag_s, abs=2e-4)
    assert 0.0 < found.half_width_s < 5e-4


def test_a_hand_that_is_there_before_it_is_told_is_one():
    told, hand, *_ = measured(np.random.default_rng(3), 0.0, 0.0)
    early = Trajectory(hand.t_s - 0.004, hand.x_m, hand.y_m, hand.angle_rad)
    with pytest.raises(MisfitError, match="no delay within"):
        arm_lag(told, early)
