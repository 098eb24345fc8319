"""A wrench among the markers of a prepared study: its rows, its noise, its unit, and back."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.model import CableModel
from cell.identify.fit import variance_inflation
from cell.lab.data.gauges import joined, row_means
from cell.lab.data.noise_model import NoiseUnknownError
from cell.lab.data.prepared import PreparedStudy, as_measured, with_noise_model
from cell.lab.verdict.smooth_part import FastPart
from cell.study.data import Markers, Trial, Wrench, WrenchSensor
from tools.worlds.made_studies import WORLD, random_model, stroke
from tools.worlds.rig_kinds import KINDS
from tools.worlds.rigs import rig_study

RIG = KINDS["wrench"](1)


@pytest.fixture(scope="module")
def study():
    return rig_study(RIG, None)


@pytest.fixture(scope="module")
def truth() -> CableModel:
    return random_model(np.random.default_rng([RIG.seed, 2]), RIG.cable, ())


def trial_with(wrench, frames_s):
    hand, places = stroke(0.0, (0.0, -0.05), 0.3), np.zeros((len(frames_s), 1, 2))
    return Trial("down", "fit", "equilibrium", hand, Markers(frames_s, places), wrench=wrench)


def waves(t_s):
    """A wrench that swings 20, 60 and 90 times a second."""
    return np.stack([np.sin(2.0 * np.pi * f * t_s) for f in (20.0, 60.0, 90.0)], axis=1)


def test_a_fast_sensor_is_means_of_its_rows_at_the_frames():
    frames, t_s = np.arange(0.0, 1.0, 0.004) + 3e-4, np.arange(-0.1, 1.1, 0.001)
    told = joined(trial_with(Wrench(t_s, waves(t_s)), frames))
    np.testing.assert_array_equal(told.trial.markers.t_s, frames)
    near = np.abs(t_s - frames[100]) <= 0.002
    np.testing.assert_allclose(
        told.trial.markers.xy_m[100, 1:].ravel()[:3], waves(t_s)[near].mean(axis=0)
    )


def test_between_slow_frames_it_has_means_of_its_own():
    frames, t_s = np.arange(0.0, 1.0, 0.03), np.arange(0.0, 1.0, 0.001)
    told = joined(trial_with(Wrench(t_s, waves(t_s)), frames))
    at_s = told.trial.markers.t_s
    assert np.isin(frames, at_s).all()
    assert np.diff(at_s).max() == pytest.approx(0.005)
    assert told.frames.sum() == len(frames)
    assert told.rows.all()


def test_a_sensor_as_slow_as_the_camera_keeps_its_rows():
    frames = np.arange(0.0, 1.0, 0.005)
    t_s = np.sort(np.concatenate([frames[::2] + 1e-8, frames[1::2] + 1e-3]))[:-1]
    told = joined(trial_with(Wrench(t_s, waves(t_s)), frames))
    at_s, values = told.alone.markers.t_s, told.alone.markers.xy_m[:, 1:].reshape(-1, 4)[:, :3]
    np.testing.assert_allclose(at_s, t_s, atol=1e-6)
    assert np.isin(frames[::2], at_s).all()
    np.testing.assert_array_equal(values, waves(t_s))
    assert told.trial.row_means is None


def test_each_row_of_a_fast_sensor_stands_by_itself_where_that_is_wanted():
    frames, t_s = np.arange(0.0, 1.0, 0.03), np.arange(0.0, 0.97, 0.001)
    told = joined(trial_with(Wrench(t_s, waves(t_s)), frames), averaged=False)
    assert told.trial.row_means is None
    assert told.rows.sum() == np.count_nonzero(t_s <= frames[-1])


def test_an_axis_that_is_not_measured_is_no_part_of_a_mean():
    t_s = np.arange(0.0, 1.0, 0.001)
    values = waves(t_s)
    values[:, 2], values[::2, 1] = np.nan, np.nan
    means = row_means(Wrench(t_s, values), np.array([0.5]), 0.0045)
    (shown,) = means.of(waves(t_s))
    near = slice(498, 503)
    np.testing.assert_allclose(
        shown[:2], [waves(t_s)[near, 0].mean(), waves(t_s)[499:503:2, 1].mean()]
    )
    assert np.isnan(shown[2])


@pytest.mark.parametrize("seed", [1, 6])
def test_means_of_a_fast_sensor_are_compared_with_means_of_the_model(seed):
    """Without any noise the true cable leaves nothing, however fast its force swings."""
    rig = KINDS["wrench"](seed)
    cable = random_model(np.random.default_rng([seed, 2]), rig.cable, ())
    prepared = PreparedStudy.of(rig_study(rig, None, quiet=True), solver=WORLD)
    assert all(t.row_means is not None for t in prepared.study.trials)
    for trial in prepared.study.trials[:2]:
        white = prepared.white(trial, prepared.predict(trial, [cable]))[0]
        assert np.abs(white).max() < 0.05


def test_noise_is_that_of_each_kind_and_as_a_length_the_markers(study, truth):
    """Whitened residuals of the true cable have unit size, in spite of tare and gain."""
    prepared = PreparedStudy.of(study)
    gauges, sensor = prepared.gauges, RIG.sensor
    rows = np.median([np.median(t.row_means.rows) for t in prepared.study.trials])
    assert sensor.force_n / np.sqrt(rows) < gauges.force.noise.std_m < sensor.force_n
    np.testing.assert_allclose(
        gauges.scale[:, 0] * [gauges.force.noise.std_m, gauges.moment.noise.std_m],
        prepared.noise_model.noise.std_m,
    )
    trials = prepared.study.trials
    predicted = prepared.predict_all(trials, [truth])
    for trial, points in zip(trials, predicted, strict=True):
        white = prepared.white(trial, points)[0]
        assert white @ white / prepared.whiteners[trial.name].count == pytest.approx(1.0, abs=0.3)
    errors = [
        gauges.of_wrench(prepared.error_m(t, p[0])) for t, p in zip(trials, predicted, strict=True)
    ]
    by_axis = np.sqrt([np.nanmean(np.concatenate(errors)[:, i] ** 2) for i in range(3)])
    expected = [gauges.force.noise.std_m] * 2 + [gauges.moment.noise.std_m]
    np.testing.assert_allclose(by_axis, expected, rtol=0.3)


def test_a_study_comes_back_from_its_points(study):
    prepared = PreparedStudy.of(study)
    again = PreparedStudy.of(as_measured(prepared))
    for one, other in zip(study.trials, as_measured(prepared).trials, strict=True):
        np.testing.assert_array_equal(one.wrench.values, other.wrench.values)
        np.testing.assert_array_equal(one.markers.t_s, other.markers.t_s)
        np.testing.assert_array_equal(one.markers.xy_m, other.markers.xy_m)
    for one, other in zip(prepared.study.trials, again.study.trials, strict=True):
        np.testing.assert_array_equal(one.markers.t_s, other.markers.t_s)
        np.testing.assert_allclose(one.markers.xy_m, other.markers.xy_m, rtol=1e-9)


def test_another_noise_of_the_markers_changes_no_residual_of_the_wrench(study, truth):
    prepared = PreparedStudy.of(study)
    louder = replace(prepared.noise_model, noise=replace(prepared.noise_model.noise, std_m=3e-3))
    changed = with_noise_model(prepared, louder)
    trial, other = prepared.study.trials[0], changed.study.trials[0]
    (before,), (after,) = (
        p.predict_all([t], [truth]) for p, t in ((prepared, trial), (changed, other))
    )
    one, two = prepared.white(trial, before)[0], changed.white(other, after)[0]
    wrench = slice(2 * len(trial.markers.t_s), None)
    np.testing.assert_allclose(one[wrench], two[wrench], rtol=1e-6, atol=1e-9)
    assert changed.gauges.scale[0, 0] == pytest.approx(3e-3 / changed.gauges.force.noise.std_m)


def test_rows_between_the_pictures_do_not_hide_a_misfit(study, truth):
    """Of a sensor as fast as the camera, half a frame beside it: no two rows of one kind touch."""

    def between(t):
        t_s = t.markers.t_s[:-1] + 0.5 * np.diff(t.markers.t_s)
        values = [np.interp(t_s, t.wrench.t_s, v) for v in t.wrench.values.T]
        return replace(t, wrench=Wrench(t_s, np.stack(values, axis=1)))

    prepared = PreparedStudy.of(replace(study, trials=(between(study.trials[0]),)))
    (trial,), whitener = prepared.study.trials, prepared.whiteners["identify"]
    assert not np.any(np.isfinite(trial.markers.xy_m).all(axis=(1, 2)))
    softer = replace(truth, rigidity_n_m2=0.95 * truth.rigidity_n_m2)
    right, wrong = (prepared.white(trial, prepared.predict(trial, [m]))[0] for m in (truth, softer))
    assert variance_inflation(right, [whitener], 5) < 3.0
    assert variance_inflation(wrong, [whitener], 5) > 100.0
    fast = FastPart.of(whitener, right)
    assert fast.pairs > 0.9 * whitener.count
    assert fast.square / fast.values == pytest.approx(1.0, abs=0.3)


def test_while_fingers_hold_a_cable_its_wrench_does_not_count(study):
    first = replace(study.trials[0], start="held", release_s=0.6)
    prepared = PreparedStudy.of(replace(study, noise_std_m=1e-4, trials=(first, study.trials[1])))
    trial = prepared.study.trials[0]
    counted = np.isfinite(trial.markers.xy_m[:, -2:]).any(axis=(1, 2))
    assert trial.markers.t_s[counted].min() > 0.6


def test_noise_that_nobody_knows_is_asked_for(study):
    moving = tuple(
        replace(t, wrench=Wrench(t.wrench.t_s[o:], t.wrench.values[o:]))
        for t in study.trials
        for o in [len(t.wrench.t_s) // 2]
    )
    with pytest.raises(NoiseUnknownError, match=r"give wrench\.force_std_n in study\.yaml"):
        PreparedStudy.of(replace(study, trials=moving))
    stated = WrenchSensor(force_std_n=5e-3, moment_std_nm=2e-4)
    prepared = PreparedStudy.of(replace(study, trials=moving, sensor=stated))
    rows = np.median(prepared.study.trials[0].row_means.rows)
    noise = np.array([m.noise.std_m for m in (prepared.gauges.force, prepared.gauges.moment)])
    np.testing.assert_allclose(noise, np.array([5e-3, 2e-4]) / np.sqrt(rows))


def test_the_stated_noise_of_a_row_is_that_of_means_of_as_many_of_its_colour(study):
    """Still rows show the colour; their level beside it is known here, and nearly comes out."""
    sensor = WrenchSensor(RIG.sensor.stated(False).gauge, RIG.sensor.force_n, RIG.sensor.moment_nm)
    stated, seen = (
        PreparedStudy.of(replace(study, sensor=s)).gauges for s in (sensor, study.sensor)
    )
    for one, other in ((stated.force, seen.force), (stated.moment, seen.moment)):
        assert one.noise.std_m == pytest.approx(other.noise.std_m, rel=0.2)


def test_a_moment_alone_is_a_study_too(study, truth):
    def moment(t):
        values = t.wrench.values.copy()
        values[:, :2] = np.nan
        return replace(t, wrench=replace(t.wrench, values=values))

    prepared = PreparedStudy.of(replace(study, trials=tuple(map(moment, study.trials))))
    trial = prepared.study.trials[0]
    white = prepared.white(trial, prepared.predict(trial, [truth]))[0].reshape(3, 2, -1)
    assert np.all(white[1] == 0.0)
    assert np.mean(white[2, 0][white[2, 0] != 0.0] ** 2) == pytest.approx(1.0, abs=0.4)
