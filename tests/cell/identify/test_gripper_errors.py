import numpy as np
import pytest

from cell.cable.geometry import Motion
from cell.identify.gripper_errors import GripperLogErrors, sampled_motions
from cell.study.hand_drift import HandDrift

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


def test_likely_motions_differ_by_what_the_log_does_not_tell(log: Motion) -> None:
    others = sampled_motions(log, GripperLogErrors(samples=20, offset_rad=1e-3))
    moving = (T_S > 0.25) & (T_S < 0.45)
    smooth = [m.splines[1](T_S[moving]) for m in others]
    spread = np.std(smooth - np.mean(smooth, axis=0))
    error = np.std(log.splines[1](T_S[moving]) - stroke()[moving])
    assert spread == pytest.approx(error, rel=0.6)
    assert np.std([m.angle_rad[0] for m in others]) == pytest.approx(1e-3, rel=0.5)
    assert sampled_motions(log, GripperLogErrors(samples=0)) == []


def test_likely_motions_drift_where_a_place_was_integrated() -> None:
    motion = Motion(T_S, 0.0 * T_S, stroke(), 0.0 * T_S)
    drift = HandDrift(0.2, 0.5, (1e-3, 2e-3))
    others = sampled_motions(motion, GripperLogErrors(samples=60, drift=drift))
    ends_m = np.array([[m.splines[0](T_S[-1:])[0], m.splines[1](T_S[-1:])[0]] for m in others])
    stated_m = np.sqrt(np.sum(drift.shapes_m(T_S[-1:], motion)[:, 0] ** 2, axis=0))
    np.testing.assert_allclose(np.std(ends_m, axis=0), stated_m, rtol=0.3)
    assert not any(m.angle_rad.any() for m in others)


def test_likely_motions_turn_by_what_an_encoder_does_not_tell() -> None:
    turn = 0.2 - 5.0 * stroke()
    arm = Motion(T_S, -0.1 * np.cos(turn), -0.1 * np.sin(turn), turn)
    drift = HandDrift(0.2, 0.5, turn_std_rad=1e-3)
    for other in sampled_motions(arm, GripperLogErrors(samples=3, drift=drift)):
        error = other.angle_rad - arm.angle_rad
        assert np.ptp(error[T_S < 0.2]) == pytest.approx(0.0, abs=1e-12)
        assert 1e-5 < abs(error[0]) < 4e-3
        np.testing.assert_allclose(other.x_m, -0.1 * np.cos(turn + error), atol=1e-6)
        np.testing.assert_allclose(other.y_m, -0.1 * np.sin(turn + error), atol=1e-6)


def test_later_motions_are_those_of_a_longer_list(log: Motion) -> None:
    """Another number, other noise; the same number, the same."""
    many = sampled_motions(log, GripperLogErrors(samples=5))
    (last,) = sampled_motions(log, GripperLogErrors(samples=1), first=4)
    np.testing.assert_array_equal(last.x_m, many[4].x_m)
    assert not np.array_equal(last.x_m, many[3].x_m)
