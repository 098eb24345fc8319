"""The error of an integrated place is that of noise integrated with the velocity known at rest."""

from __future__ import annotations

import numpy as np
import pytest

from cell.cable.geometry import Motion
from cell.study.hand_drift import HandDrift

STEP_S, FROM_S, TO_S, DENSITY = 1e-3, 0.2, 0.6, 1e-3
T_S = np.arange(0.0, 1.0, STEP_S)


def grip() -> Motion:
    u = np.clip((T_S - FROM_S) / (TO_S - FROM_S), 0.0, 1.0)
    return Motion(T_S, 0.1 * u**2 * (3.0 - 2.0 * u), 0.0 * T_S, 0.0 * T_S)


def drawn(count: int, gain_std: float) -> np.ndarray:
    """(count, T) errors of x by simulation: samples of noise summed twice, less their mean."""
    rng = np.random.default_rng(0)
    within = (T_S >= FROM_S) & (T_S < TO_S)
    noise = DENSITY / np.sqrt(2.0 * STEP_S) * rng.normal(size=(count, len(T_S)))
    noise = np.where(within, noise - noise[:, within].mean(axis=1, keepdims=True), 0.0)
    path = np.cumsum(np.cumsum(noise, axis=1) * STEP_S, axis=1) * STEP_S
    return path + gain_std * rng.normal(size=(count, 1)) * grip().x_m


@pytest.mark.parametrize("gain_std", [0.0, 1e-3])
@pytest.mark.parametrize("ends_known", [False, True])
def test_shapes_have_the_covariance_of_simulated_noise(gain_std, ends_known):
    drift = HandDrift(FROM_S, TO_S, (DENSITY, 0.0), gain_std, ends_known)
    at = np.array([250, 350, 450, 550, 700, 990])
    shapes = drift.shapes_m(T_S[at], grip())[..., 0]
    errors = drawn(4000, gain_std)
    if ends_known:  # what goes with the error of the end is taken off with it
        end = errors[:, -1]
        errors = errors - np.outer(end, end @ errors / (end @ end))
    wanted = (errors.T @ errors / len(errors))[np.ix_(at, at)]
    found = shapes.T @ shapes
    assert np.abs(found - wanted).max() < 0.07 * wanted.max()
    before_m = drift.shapes_m(T_S[:150], grip())
    assert np.abs(before_m).max() < 1e-15, "the gripper rests until it moves"


def test_the_largest_standard_deviation_is_that_of_the_end():
    drift = HandDrift(FROM_S, TO_S, (DENSITY, 0.5 * DENSITY))
    xy_m = np.column_stack([grip().x_m, grip().y_m])
    wanted_m = DENSITY * np.sqrt((TO_S - FROM_S) ** 3 / 24.0)
    assert drift.largest_std_m(T_S, xy_m) == pytest.approx(wanted_m, rel=0.01)


def test_an_encoder_s_error_is_constant_at_either_rest():
    drift = HandDrift(FROM_S, TO_S, turn_std_rad=1e-4, axle_m=(0.1, 0.0))
    turns = drift.turns_rad(T_S)
    assert np.all(turns[0, T_S <= FROM_S] == 1e-4)
    assert np.all(turns[1, T_S >= TO_S] == 1e-4)
    assert np.all(turns[0, T_S > FROM_S + 0.05] == 0.0)
    assert not np.any((turns[0] > 0.0) & (turns[1] > 0.0)), "they are independent"
    moved_m = drift.turned_m(np.array([1e-4]), np.array([[0.0, 0.0]]))
    np.testing.assert_allclose(moved_m, [[0.0, -1e-5]])  # turns down as it points to the left


def test_y_is_independent_of_x():
    shapes = HandDrift(FROM_S, TO_S, (DENSITY, DENSITY)).shapes_m(T_S, grip())
    assert not np.any(shapes[..., 0].any(axis=1) & shapes[..., 1].any(axis=1))
