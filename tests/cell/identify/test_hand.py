import numpy as np
import pytest

from cell.cable.geometry import Motion
from cell.identify.hand import HandErrors, likely_motions, moves_from_s, quiet_motion

T_S = np.arange(0.0, 1.5, 0.002)


def stroke() -> np.ndarray:
    """50 mm down between 0.2 and 0.5 s with the least jerk."""
    u = np.clip((T_S - 0.2) / 0.3, 0.0, 1.0)
    y: np.ndarray = -0.05 * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5)
    return y


@pytest.fixture
def log() -> Motion:
    rng = np.random.default_rng(0)
    noise = 1e-5 * rng.normal(size=(2, len(T_S)))
    return Motion(T_S, noise[0], stroke() + noise[1], np.zeros_like(T_S))


def test_a_quiet_motion_rests_exactly_and_moves_truly(log: Motion) -> None:
    quiet = quiet_motion(log)
    error = quiet.y_m - stroke()
    for rest in (T_S < 0.15, T_S > 0.6):
        assert np.ptp(quiet.y_m[rest]) < 1e-12
        assert np.abs(error[rest]).max() < 3e-6
    assert np.std(error) < 4e-6
    assert np.abs(error).max() < 2.5e-5
    np.testing.assert_array_equal(quiet.angle_rad, 0.0)


def test_a_motion_without_noise_is_left_alone() -> None:
    clean = Motion(T_S, np.zeros_like(T_S), stroke(), np.zeros_like(T_S))
    np.testing.assert_allclose(quiet_motion(clean).y_m, clean.y_m, atol=1e-12)


def test_ringing_after_the_stop_is_not_taken_for_rest(log: Motion) -> None:
    after = np.clip(T_S - 0.5, 0.0, None)
    ringing = 3e-4 * np.exp(-after / 0.15) * np.sin(2.0 * np.pi * 12.0 * after)
    shaken = Motion(T_S, log.x_m, log.y_m + ringing, log.angle_rad)
    error = quiet_motion(shaken).y_m - stroke() - ringing
    assert np.abs(error[(T_S > 0.5) & (T_S < 1.0)]).max() < 3e-5


def test_likely_motions_differ_by_what_the_log_does_not_tell(log: Motion) -> None:
    first, *others = likely_motions(log, HandErrors(samples=20, offset_rad=1e-3))
    np.testing.assert_array_equal(first.y_m, quiet_motion(log).y_m)
    moving = (T_S > 0.25) & (T_S < 0.45)
    spread = np.std([m.y_m[moving] - first.y_m[moving] for m in others])
    truly = np.std(first.y_m[moving] - stroke()[moving])
    assert spread == pytest.approx(truly, rel=1.0)
    assert np.std([m.angle_rad[0] for m in others]) == pytest.approx(1e-3, rel=0.5)
    assert len(likely_motions(log, HandErrors(samples=0))) == 1


def test_when_the_hand_first_moves(log: Motion) -> None:
    assert 0.2 < moves_from_s(log) < 0.26
    still = Motion(T_S, log.x_m, np.zeros_like(T_S), log.angle_rad)
    assert moves_from_s(still) == float("inf")
    turned = Motion(T_S, log.x_m, np.zeros_like(T_S), np.where(T_S < 0.7, 0.0, 0.01))
    assert moves_from_s(turned) == pytest.approx(0.7)
