"""A copy is the same study once more: same motions and gaps, noise of the same kind, an effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.effects import library
from cell.identify.gauss_newton import UnsimulatedError
from cell.identify.noise import Noise
from cell.lab.data.noise_model import noise_model_of
from cell.lab.fit.sensitivity import changes
from cell.lab.next.simulated import HiddenEffectWorld, refit_residual

MASS_KG = 2.5e-5


@pytest.fixture(scope="module")
def world(fitted):
    hidden = library()["tip_mass"].active(mass_kg=MASS_KG)
    return HiddenEffectWorld.of(fitted.prepared, fitted.base.fit, hidden)


def test_a_copy_has_the_frames_markers_and_gaps_of_the_study(world):
    copy = world.copy(3)
    for trial, made in zip(world.study.trials, copy.trials, strict=True):
        assert (made.name, made.role, made.start) == (trial.name, trial.role, trial.start)
        np.testing.assert_array_equal(made.markers.t_s, trial.markers.t_s)
        np.testing.assert_array_equal(
            np.isfinite(made.markers.xy_m), np.isfinite(trial.markers.xy_m)
        )


def test_a_copy_is_the_same_each_time_and_its_noise_another_than_the_next_ones(world):
    one, again, other = (world.copy(n).trials[1].markers.xy_m for n in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert np.std(one - other) == pytest.approx(np.sqrt(2.0) * 1e-4, rel=0.1)


@pytest.mark.parametrize("white", [0.0, 0.4])
def test_the_noise_has_the_level_colour_and_white_share_of_the_study(world, white):
    noise = Noise(2e-4, 0.6, white=white)
    noisy = replace(
        world,
        prepared=replace(
            world.prepared, noise_model=replace(world.prepared.noise_model, noise=noise, rest=None)
        ),
    )
    errors = [
        t.markers.xy_m - world.clean_m[t.name] for n in range(8) for t in noisy.copy(n).trials[1:]
    ]
    assert np.std(np.concatenate(errors)) == pytest.approx(2e-4, rel=0.03)
    pairs = [(e[1:] * e[:-1]).mean() / (e * e).mean() for e in errors]
    assert np.mean(pairs) == pytest.approx(0.6 * (1.0 - white), abs=0.03)


def test_rounded_values_stay_rounded(world):
    rest = replace(world.prepared.noise_model.rest, resolution_m=5e-5)
    model = replace(world.prepared.noise_model, rest=rest, noise=Noise(1e-4, 0.3, white=0.02))
    rounded = replace(world, prepared=replace(world.prepared, noise_model=model))
    steps = rounded.copy(0).trials[1].markers.xy_m / 5e-5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    found = noise_model_of(rounded.copy(0)).noise.std_m
    assert found == pytest.approx(1e-4, rel=0.15)


def test_the_effect_is_in_it(fitted, world):
    without = HiddenEffectWorld.of(fitted.prepared, fitted.base.fit, None)
    moved = world.clean_m["deep"] - without.clean_m["deep"]
    assert np.abs(moved).max() > 1e-4


def test_without_noise_a_refit_leaves_what_its_parameters_cannot_imitate(fitted, linear):
    """A weak effect: as slopes say.  None at all: nothing."""
    drag, fit = library()["air_drag"], fitted.base.fit
    left = refit_residual(fitted.prepared, fit, drag.active(drag_coefficient=0.05))
    hidden = changes(
        linear.all_trials.prepared, linear.all_trials.fit, [drag.active(drag_coefficient=0.05)]
    )
    expected = linear.project_out_fitted(hidden)[0] + linear.heldout(hidden)[0]
    assert np.linalg.norm(left - expected) < 0.05 * np.linalg.norm(expected)
    nothing = refit_residual(fitted.prepared, fit, drag.active(drag_coefficient=0.0))
    assert np.linalg.norm(nothing) < 1e-3 * np.linalg.norm(expected)


def test_an_effect_with_which_nothing_can_be_simulated_is_told(fitted):
    heavy = library()["tip_mass"].active(mass_kg=10.0)
    with pytest.raises(UnsimulatedError):
        HiddenEffectWorld.of(fitted.prepared, fitted.base.fit, heavy)
    with pytest.raises(UnsimulatedError):
        refit_residual(fitted.prepared, fitted.base.fit, heavy)
