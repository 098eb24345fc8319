"""What a mesh and a gripper's noisy log do to a fit's residual: as much as they really do."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.geometry import Motion
from cell.identify.parameters import ParameterSpace
from cell.lab.data.prepared import PreparedStudy
from cell.lab.fit.fitting import fit_model, fit_trials
from cell.lab.fit.systematic_error import systematic_error

LOG_M = 1e-5


@pytest.fixture(scope="module")
def quiet(make_study):
    """A study with hardly any noise, in units of 0.1 mm."""
    study = replace(make_study([], noise_m=1e-9, ar1=0.0, seed=3), noise_std_m=1e-4)
    return replace(study, trials=study.trials[:2])


def fitted(study):
    prepared = PreparedStudy.of(study)
    space = ParameterSpace.of(study.cable)
    return prepared, fit_model(prepared, space, space.start(2.5e-5))


def logged(trial, seed):
    """The trial with noise in its log."""
    rng, hand = np.random.default_rng(seed), trial.grip
    x, y = (v + LOG_M * rng.normal(size=len(v)) for v in (hand.x_m, hand.y_m))
    return replace(trial, grip=Motion(hand.t_s, x, y, hand.angle_rad))


def test_most_of_what_a_fit_leaves_without_noise_is_its_mesh(quiet):
    prepared, fit = fitted(quiet)
    wrong = systematic_error(prepared, fit, fit_trials(prepared))
    answers = np.linalg.qr(fit.solution.jacobian)[0]
    mesh = wrong.mesh - answers @ (answers.T @ wrong.mesh)
    left = fit.solution.residual - answers @ (answers.T @ fit.solution.residual)
    assert np.linalg.norm(left + mesh) < 0.4 * np.linalg.norm(left)
    assert not np.any(wrong.gripper_motions)


def test_other_hands_move_a_cable_as_much_as_the_noise_of_the_log_did(quiet):
    prepared, fit = fitted(quiet)
    trials = fit_trials(prepared)
    there = prepared.all_white(trials, [fit.model])[0]
    real = []
    for seed in range(6):
        noisy = [logged(t, seed) for t in trials]
        real.append(prepared.all_white(noisy, [fit.model])[0] - there)
    noisy = replace(prepared, study=replace(quiet, trials=tuple(noisy)))
    wrong = systematic_error(noisy, fit, fit_trials(noisy))
    expected, seen = (np.mean(np.sum(np.square(v), axis=1)) for v in (wrong.gripper_motions, real))
    assert 0.5 < expected / seen < 2.0
    assert wrong.variance(there) > 0.0
