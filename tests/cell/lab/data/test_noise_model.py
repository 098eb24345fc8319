"""Noise from still frames: level and colour without bias, also while the cable still settles."""

from dataclasses import replace

import numpy as np
import pytest

from cell.identify.noise import Noise
from cell.lab.data.noise_likelihood import ProjectedResidual, rounding_ar1
from cell.lab.data.noise_model import (
    KNOWN_WITHIN,
    NoiseModel,
    NoiseUnknownError,
    noise_model_of,
    noise_model_of_all_frames,
    noise_model_of_residuals,
)
from cell.study.data import Markers
from tests.cell.lab.conftest import coloured, rounded


@pytest.mark.parametrize("colour", [0.0, 0.5, 0.9])
def test_level_and_colour_are_recovered(make_study, colour):
    found = [noise_model_of(make_study(seed=s, ar1=colour, noise_m=2e-4)).noise for s in range(3)]
    assert np.mean([n.ar1 for n in found]) == pytest.approx(colour, abs=0.05)
    assert np.mean([n.std_m for n in found]) == pytest.approx(
        2e-4, rel=0.03 if colour < 0.6 else 0.1
    )


def test_a_settling_cable_does_not_count_as_noise(make_study):
    def settling(trial):
        return trial.markers.xy_m + 2e-3 * np.exp(-trial.markers.t_s / 0.15)[:, None, None]

    found = noise_model_of(make_study(ar1=0.0).with_places(settling)).noise
    assert found.std_m == pytest.approx(1e-4, rel=0.1)
    assert found.ar1 < 0.2


def test_lost_frames_and_markers_cost_no_more_than_themselves(make_study):
    """Every marker lost once at rest, and all of them in one frame."""
    study = make_study(ar1=0.5, noise_m=2e-4)

    def gappy(trial):
        xy_m = trial.markers.xy_m.copy()
        xy_m[5] = np.nan
        for marker in range(xy_m.shape[1]):
            xy_m[8 + marker % 3, marker] = np.nan
        return xy_m

    noise_model, whole = noise_model_of(study.with_places(gappy)), noise_model_of(study)
    assert noise_model.noise.std_m == pytest.approx(2e-4, rel=0.05)
    assert noise_model.noise.ar1 == pytest.approx(0.5, abs=0.1)
    assert 0.5 * whole.dof < noise_model.dof < whole.dof


def test_a_stated_level_is_kept(make_study):
    assert noise_model_of(replace(make_study(), noise_std_m=3e-4)).noise.std_m == 3e-4


def test_without_still_frames_the_level_must_be_given(make_study):
    study = make_study()
    late = [
        replace(t, markers=Markers(t.markers.t_s[50:], t.markers.xy_m[50:])) for t in study.trials
    ]
    moving = replace(study, trials=tuple(late))
    with pytest.raises(NoiseUnknownError, match="noise_std_m"):
        noise_model_of(moving)
    assert noise_model_of(replace(moving, noise_std_m=1e-4)).noise.std_m == 1e-4


def test_a_stated_error_is_as_correlated_as_what_a_model_leaves():
    """Shapes fitted to pictures err along the whole cable at once, and stay for some frames."""
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(3):
        shapes = np.repeat(rng.normal(size=(60, 2, 2)), 3, axis=0)
        along = np.linspace(0.1, 1.0, 6)[:, None] ** np.arange(1, 3)
        errors.append(1e-3 * np.einsum("tkc,mk->tmc", shapes, along).reshape(180, 12))
    errors[0][5:9, 3] = np.nan
    stated = NoiseModel(Noise(1e-3, 0.9), np.inf)
    found = noise_model_of_residuals(stated, errors)
    assert found.noise.std_m == 1e-3
    assert found.noise.ar1 == pytest.approx(2.0 / 3.0, abs=0.06)
    assert 12.0 / found.correlated_channels == pytest.approx(
        2.4, rel=0.2
    )  # of two shapes, two coordinates
    assert found.for_whitening.std_m == pytest.approx(1e-3 * np.sqrt(found.correlated_channels))
    white = [1e-3 * rng.normal(size=(180, 12)) for _ in range(3)]
    alone = noise_model_of_residuals(replace(stated, autocorrelated=False), white)
    assert alone.correlated_channels == pytest.approx(1.0, abs=0.1)
    assert alone.noise.ar1 == pytest.approx(0.0, abs=0.05)
    bound = replace(stated, noise=Noise(1e-3, 0.3))
    assert noise_model_of_residuals(bound, errors).noise.ar1 == 0.3
    seen = NoiseModel(Noise(1e-3, 0.9), 400.0)
    assert noise_model_of_residuals(seen, errors) == seen


def cut(study, frames, markers):
    """The study with so many still frames and markers, its first trial alone."""
    trial = study.trials[0]
    begin = int(np.searchsorted(trial.markers.t_s, 0.19)) - frames
    seen = Markers(trial.markers.t_s[begin:], trial.markers.xy_m[begin:, :markers])
    arcs = study.arc_length_m[:markers]
    return replace(study, arc_length_m=arcs, trials=(replace(trial, markers=seen),))


def beside_nothing(errors_m):
    """A remainder of one trial from which nothing was taken."""
    return ProjectedResidual((errors_m,), (np.zeros((*errors_m.shape, 0)),))


def moving(seed, noise_m, colour, frames=150, channels=2):
    errors_m = noise_m * coloured(np.random.default_rng(seed), (frames, channels), colour)
    return beside_nothing(errors_m)


def test_few_still_frames_are_helped_by_those_in_motion(make_study):
    """By 12 frames of one marker the level is right to 30 %, by all to 8 %; colour likewise."""
    alone, helped = [], []
    for seed in range(6):
        noise_model = noise_model_of(cut(make_study(seed=seed, ar1=0.6), 12, 1))
        found = noise_model_of_all_frames(noise_model, moving(seed, 1e-4, 0.6))
        alone.append([noise_model.noise.std_m / 1e-4, noise_model.noise.ar1])
        helped.append([found.noise.std_m / 1e-4, found.noise.ar1])
        assert found.dof > noise_model.dof
    before, after = (np.sqrt(np.mean((np.array(v) - [1.0, 0.6]) ** 2, 0)) for v in (alone, helped))
    assert np.all(after < [0.2, 0.15])
    assert np.all(after < 0.5 * before)


def test_what_the_rest_does_not_allow_is_no_noise(make_study):
    """A misfit of three times the noise stays one, beside a long rest and a short one."""
    for frames, most in ((38, 1.3), (12, 2.6)):
        noise_model = noise_model_of(cut(make_study(ar1=0.0), frames, 2))
        found = noise_model_of_all_frames(noise_model, moving(0, 3e-4, 0.8))
        assert found.noise.std_m < most * 1e-4
        assert found.dof == noise_model.dof


def test_a_known_level_and_a_long_rest_are_left_alone(make_study):
    stated = noise_model_of(replace(make_study(), noise_std_m=1e-4))
    assert noise_model_of_all_frames(stated, moving(0, 3e-4, 0.8)) is stated
    noise_model = noise_model_of(make_study(ar1=0.3))
    found = noise_model_of_all_frames(noise_model, moving(0, 1e-4, 0.3))
    assert found.noise.std_m == pytest.approx(noise_model.noise.std_m, rel=0.03)
    assert found.allowed_over_level < KNOWN_WITHIN


def test_whether_the_rest_was_long_enough_is_told(make_study):
    """Twelve frames of a marker leave room for an error as large as the noise, forty do not."""
    study = make_study(seed=1, ar1=0.0)
    short = noise_model_of_all_frames(noise_model_of(cut(study, 10, 1)), moving(1, 1e-4, 0.0))
    assert short.allowed_over_level >= KNOWN_WITHIN
    assert short.frames_needed >= 20
    long = noise_model_of_all_frames(noise_model_of(cut(study, 38, 2)), moving(1, 1e-4, 0.0))
    assert long.allowed_over_level < KNOWN_WITHIN
    assert long.range_m[0] < 1e-4 < long.range_m[1]


def test_values_rounded_to_more_than_they_vary_hide_their_error(make_study):
    """Steps of 0.4 mm, noise of 0.02 mm: at rest nearly nothing moves, in motion 0.115 mm err."""
    step_m = 4e-4
    noise_model = noise_model_of(rounded(make_study(noise_m=2e-5), step_m))
    assert noise_model.noise.std_m == pytest.approx(step_m / np.sqrt(12.0), rel=1e-6)
    found = noise_model_of_all_frames(noise_model, moving(0, 1.3e-4, 0.0))
    assert found.noise.std_m == pytest.approx(1.3e-4, rel=0.1)
    gross = noise_model_of_all_frames(noise_model, moving(0, 6e-4, 0.0))
    assert step_m / np.sqrt(12.0) < gross.noise.std_m < 0.5 * step_m


def test_rounding_beside_coloured_noise_is_white(make_study):
    """The slow part is that of what is coloured: of one AR(1) for both it would be a half."""
    step_m, rng = 2e-4, np.random.default_rng(0)
    noise_model = noise_model_of(rounded(make_study(ar1=0.8), step_m))
    errors = 1e-4 * coloured(rng, (400, 22), 0.8) + step_m * rng.uniform(-0.5, 0.5, (400, 22))
    found = noise_model_of_all_frames(noise_model, beside_nothing(errors))
    assert found.noise.ar1 == pytest.approx(0.8, abs=0.04)
    assert found.noise.white == pytest.approx(0.25, abs=0.1)
    slow = found.noise.std_m**2 / found.noise.effective_fraction
    assert slow == pytest.approx(1e-8 * 9.0 + step_m**2 / 12.0, rel=0.2)


def test_a_rest_that_is_short_for_its_slow_noise_still_shows_it_beside_rounding(make_study):
    """Steps of 1.6 times the noise hide it no more than they would in a rest without end.

    Within 40 frames a noise of AR(1) 0.92 varies by half of what it does in all.
    """
    noise_m, step_m = 1e-4, 1.6e-4
    true_m = np.sqrt(noise_m**2 + step_m**2 / 12.0)
    slow_m2 = noise_m**2 * 1.92 / 0.08
    for seed in range(4):
        study = rounded(make_study(seed=seed, ar1=0.92, noise_m=noise_m), step_m)
        noise_model = noise_model_of(study)
        allowed = noise_model.rest.confidence_set
        assert not allowed.hidden
        assert allowed.range_m[1] > true_m
        errors_m = noise_m * coloured(np.random.default_rng(seed), (400, 22), 0.92)
        errors_m += step_m * np.random.default_rng(seed + 9).uniform(-0.5, 0.5, errors_m.shape)
        found = noise_model_of_all_frames(noise_model, beside_nothing(errors_m))
        slow = found.noise.std_m**2 / found.noise.effective_fraction
        assert slow == pytest.approx(slow_m2 + step_m**2 / 12.0, rel=0.25)


@pytest.mark.parametrize("ar1, std", [(0.92, 0.6), (0.92, 0.3), (0.8, 0.3), (0.0, 0.2)])
def test_how_alike_rounding_errs_in_neighbouring_frames(ar1, std):
    """Beside a long simulation, in steps."""
    rng, count = np.random.default_rng(1), 400_000
    one = rng.normal(size=count)
    other = ar1 * one + np.sqrt(1.0 - ar1**2) * rng.normal(size=count)
    place = rng.uniform(size=count)
    errors = [np.round(place + std * n) - place - std * n for n in (one, other)]
    variance = std**2 + 1.0 / 12.0
    found = rounding_ar1(variance, ar1, 1.0 / 12.0 / variance, 1.0)
    assert found == pytest.approx(12.0 * np.mean(errors[0] * errors[1]), abs=0.01)


def test_white_noise_beside_rounding_makes_it_white():
    """A white share that is four times that of rounding."""
    assert rounding_ar1(1.0, 0.9, 0.5, np.sqrt(12.0 * 0.125)) < 0.01


def test_two_cameras_in_one_table_show_their_noise(make_study):
    """No marker was seen in six rows one after the other, and the study was refused."""
    study = make_study(seed=2, ar1=0.5, noise_m=2e-4)
    trials = []
    for trial in study.trials:
        t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
        rows = np.full((2 * len(t_s), *xy_m.shape[1:]), np.nan)
        rows[::2, ::2], rows[1::2, 1::2] = xy_m[:, ::2], xy_m[:, 1::2]
        times_s = np.sort(np.concatenate([t_s, t_s + 1e-3]))
        trials.append(replace(trial, markers=Markers(times_s, rows)))
    apart, alone = noise_model_of(replace(study, trials=tuple(trials))), noise_model_of(study)
    assert apart.noise.std_m == pytest.approx(alone.noise.std_m, rel=0.05)
    assert apart.noise.ar1 == pytest.approx(alone.noise.ar1, abs=0.05)
