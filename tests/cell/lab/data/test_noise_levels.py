"""Markers whose noise differs are weighed by it; where chance makes them differ nothing changes."""

from dataclasses import replace

import numpy as np
import pytest

from cell.lab.data.noise_model import noise_model_of, with_level_in, with_levels
from cell.lab.data.prepared import PreparedStudy
from cell.study.data import Markers
from tests.cell.lab.conftest import rounded


def noisier(study, factors, seed=0, std_m=1e-4, draw=np.random.Generator.standard_normal):
    """A study with white noise of so many times `std_m`, (trials, markers), beside its own."""
    rng, each = np.random.default_rng(seed), iter(factors)

    def noisy(trial):
        noise = draw(rng, size=trial.markers.xy_m.shape) * std_m * next(each)[:, None]
        return trial.markers.xy_m + noise

    return study.with_places(noisy)


def heavy_tailed(rng, size):
    return rng.standard_t(4, size) / np.sqrt(2.0)


@pytest.mark.parametrize("draw", [np.random.Generator.standard_normal, heavy_tailed])
def test_noise_that_is_alike_has_one_level(make_study, draw):
    study = make_study(noise_m=1e-9)
    alike = np.ones((len(study.trials), len(study.arc_length_m)))
    for seed in range(20):
        noisy = noisier(study, alike, seed, draw=draw)
        noise_model = noise_model_of(noisy)
        assert with_levels(noisy, noise_model) is noise_model


def test_levels_of_markers_and_trials_are_found(make_study):
    study = make_study(noise_m=1e-9)
    rng = np.random.default_rng(3)
    factors = np.exp(rng.uniform(-0.6, 0.6, (len(study.trials), len(study.arc_length_m))))
    factors /= np.sqrt(np.mean(factors**2))
    noisy = noisier(study, factors)
    noise_model = with_levels(noisy, noise_model_of(noisy))
    found = np.array([noise_model.levels[t.name].of_markers for t in study.trials])
    assert np.std(np.log(found / factors)) < 0.12  # 40 still frames tell a level to 8 %
    assert noise_model.noise.std_m == pytest.approx(1e-4, rel=0.1)


def test_a_marker_that_is_lost_at_rest_has_its_level_of_other_trials(make_study):
    study = make_study(noise_m=1e-9)
    factors = np.ones((len(study.trials), len(study.arc_length_m)))
    factors[:, 0] = 4.0
    noisy = noisier(study, factors)
    first, *rest = noisy.trials
    xy_m = first.markers.xy_m.copy()
    xy_m[first.markers.t_s < 0.25, 0] = np.nan
    lost = replace(first, markers=Markers(first.markers.t_s, xy_m))
    noisy = replace(noisy, trials=(lost, *rest))
    levels = with_levels(noisy, noise_model_of(noisy)).levels[first.name].of_markers
    assert levels[0] / np.median(levels[1:]) == pytest.approx(4.0, rel=0.15)


def test_stated_noise_and_noise_hidden_by_rounding_have_one_level(make_study):
    study = make_study(noise_m=1e-9)
    factors = np.ones((len(study.trials), len(study.arc_length_m)))
    factors[:, 0] = 4.0
    noisy = noisier(study, factors)
    stated = replace(noisy, noise_std_m=1e-4)
    assert not with_levels(stated, noise_model_of(stated)).levels
    coarse = noisy.with_places(lambda trial: np.round(trial.markers.xy_m, 2))
    assert not with_levels(coarse, noise_model_of(coarse)).levels


def test_whitened_noise_has_unit_size_in_every_marker(make_study):
    study = make_study(noise_m=1e-9)
    factors = np.ones((len(study.trials), len(study.arc_length_m)))
    factors[0], factors[1:, -1] = 3.0, 0.5
    prepared = PreparedStudy.of(noisier(study, factors))
    for trial, clean in zip(prepared.study.trials, study.trials, strict=True):
        white = prepared.white(trial, clean.markers.xy_m[None])[0]
        size = np.sqrt(np.mean(white.reshape(len(study.arc_length_m), -1) ** 2, axis=1))
        assert np.allclose(size, 1.0, atol=0.25)
    assert prepared.noise_m("fit") > prepared.noise_m("validate")


def test_a_trial_without_rest_has_the_level_of_its_markers_and_is_little_known(make_study):
    study = make_study(noise_m=1e-9)
    rng = np.random.default_rng(3)
    factors = np.exp(rng.uniform(-0.6, 0.6, (len(study.trials), len(study.arc_length_m))))
    noisy = noisier(study, factors)
    *rest, last = noisy.trials
    late = last.markers.t_s > 0.2
    cut = Markers(last.markers.t_s[late], last.markers.xy_m[late])
    noisy = replace(noisy, trials=(*rest, replace(last, markers=cut)))
    found = with_levels(noisy, noise_model_of(noisy))
    known, unknown = found.levels[rest[0].name], found.levels[last.name]
    assert np.all(np.isfinite(unknown.of_markers)) and unknown.dof < 0.3 * known.dof


def test_frames_of_fitted_trials_tell_nothing_of_the_noise_of_one_held_out(make_study):
    study = make_study(noise_m=1e-9)
    factors = np.ones((len(study.trials), len(study.arc_length_m)))
    factors[:, 0] = 4.0
    noisy = noisier(study, factors)
    before = with_levels(noisy, noise_model_of(noisy))
    told = replace(before, noise=replace(before.noise, std_m=0.9 * before.noise.std_m))
    after = with_level_in(before, told, noisy.role("fit"))
    for trial in noisy.trials:
        was, now = (m.noise.std_m * m.levels[trial.name].of_markers for m in (before, after))
        assert now == pytest.approx(was * (0.9 if trial.role == "fit" else 1.0))
    held = noisy.role("validate")
    assert after.dof_in(held) == sum(after.levels[t.name].dof for t in held) < after.dof


def test_a_marker_that_repeats_its_values_at_rest_is_not_believed_to_be_exact(make_study):
    study = make_study(noise_m=1e-9)
    noisy = noisier(study, np.ones((len(study.trials), len(study.arc_length_m))))
    first, *rest = noisy.trials
    xy_m = first.markers.xy_m.copy()
    xy_m[first.markers.t_s < 0.3, 0] = xy_m[0, 0]
    held = replace(noisy, trials=(replace(first, markers=Markers(first.markers.t_s, xy_m)), *rest))
    level = with_levels(held, noise_model_of(held)).levels[first.name].of_markers
    assert level[0] > 0.15 * np.median(level)


def test_rounded_to_more_than_its_noise_no_marker_has_a_level_of_its_own(make_study):
    """At rest one stays within a step, which it seems to be without noise, and one does not."""
    study = make_study(noise_m=1e-9)
    noisy = noisier(study, np.ones((len(study.trials), len(study.arc_length_m))))
    coarse = rounded(noisy, 2.2e-4)
    noise_model = noise_model_of(coarse)
    assert not noise_model.rest.is_hidden(noise_model.noise.std_m)
    assert with_levels(coarse, noise_model) is noise_model
