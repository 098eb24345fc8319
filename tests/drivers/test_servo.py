from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import Pose, Trajectory
from drivers.servo import servo_response


def ramp(duration_s: float = 0.5, length_m: float = 0.1) -> Trajectory:
    t = np.array([0.0, duration_s])
    return Trajectory(t, np.array([0.0, length_m]), np.zeros(2), np.zeros(2))


def test_ramp_is_followed_one_lag_late() -> None:
    response = servo_response(ramp(), lag_s=0.03)
    assert np.interp(0.4, response.t_s, response.x_m) == pytest.approx(0.2 * 0.37, abs=1e-6)


def test_matches_the_analytic_response_to_a_ramp() -> None:
    tau, v = 0.015, 0.2
    response = servo_response(ramp(), lag_s=2 * tau)
    t = response.t_s[response.t_s <= 0.5]
    exact = v * (t - 2 * tau + (t + 2 * tau) * np.exp(-t / tau))
    assert response.x_m[: len(t)] == pytest.approx(exact, abs=1e-12)


def test_never_overshoots_and_comes_to_rest() -> None:
    response = servo_response(ramp(), lag_s=0.05)
    assert response.x_m.max() <= 0.1
    assert np.all(np.diff(response.x_m) >= 0.0)
    assert response.x_m[-1] == pytest.approx(0.1, abs=1e-6)


def test_no_lag_is_the_path_itself() -> None:
    response = servo_response(ramp(), lag_s=0.0)
    assert response.x_m == pytest.approx(0.2 * response.t_s, abs=1e-15)


def test_starts_where_the_arm_rests_and_ends_on_the_path() -> None:
    response = servo_response(ramp(), lag_s=0.03, start=Pose(-0.001, 0.002))
    assert (response.x_m[0], response.y_m[0]) == (-0.001, 0.002)
    assert np.abs(np.diff(response.y_m)).max() < 0.002 * 0.06  # no jump
    assert response.y_m[-1] == pytest.approx(0.0, abs=1e-7)


def test_refuses_a_negative_lag() -> None:
    with pytest.raises(ValueError, match=r"lag_s = -0.1"):
        servo_response(ramp(), lag_s=-0.1)
