"""When the gripper first moves, by its log."""

import numpy as np
import pytest

from cell.cable.geometry import ROUGHLY_STILL, Motion, moves_from_s

T_S = np.arange(0.0, 1.5, 0.002)


def test_the_first_move_is_found_in_a_noisy_log() -> None:
    rng = np.random.default_rng(0)
    x_m, noise_m = 1e-5 * rng.normal(size=(2, len(T_S)))
    u = np.clip((T_S - 0.2) / 0.3, 0.0, 1.0)
    down_m = -0.05 * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5)
    level = np.zeros_like(T_S)
    assert 0.2 < moves_from_s(Motion(T_S, x_m, down_m + noise_m, level)) < 0.26
    assert moves_from_s(Motion(T_S, x_m, noise_m, level)) == float("inf")
    turned = Motion(T_S, x_m, noise_m, np.where(T_S < 0.7, 0.0, 0.01))
    assert moves_from_s(turned) == pytest.approx(0.7)


def test_a_glitch_of_the_log_is_no_motion() -> None:
    """One wrong sample before a stroke, and no frame counted as still: a study was refused."""
    u = np.clip((T_S - 0.2) / 0.3, 0.0, 1.0)
    down_m = -0.05 * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5)
    level = np.zeros_like(T_S)
    begins_s = moves_from_s(Motion(T_S, level, down_m, level))
    wrong_m = down_m.copy()
    wrong_m[[0, 30, 60, 61]] += 2e-4
    assert moves_from_s(Motion(T_S, level, wrong_m, level)) == begins_s
    wrong_m[60:63] += 2e-4
    assert moves_from_s(Motion(T_S, level, wrong_m, level)) == T_S[60]


def test_a_hand_that_leaves_with_the_last_sample_has_moved() -> None:
    last_m = np.where(T_S[-1] == T_S, 1e-3, 0.0)
    level = np.zeros_like(T_S)
    assert moves_from_s(Motion(T_S, last_m, level, level)) == T_S[-1]


def test_a_rough_log_may_wander_more() -> None:
    wandering_m = 5e-4 * np.sin(20.0 * T_S)
    motion = Motion(T_S, wandering_m, 0.0 * T_S, 0.0 * T_S)
    assert moves_from_s(motion) < 0.05
    assert moves_from_s(motion, ROUGHLY_STILL) == float("inf")


def test_a_log_of_other_numbers_is_refused() -> None:
    with pytest.raises(ValueError, match=r"motion\.x_m is no array of 64-bit floats"):
        Motion(T_S, np.zeros(len(T_S), dtype=int), 0.0 * T_S, 0.0 * T_S)
