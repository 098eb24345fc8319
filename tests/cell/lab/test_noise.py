"""Noise from still frames: level and colour without bias, also while the cable still settles."""

from dataclasses import replace

import numpy as np
import pytest

from cell.identify.noise import Noise
from cell.lab.noise import Floor, NoiseUnknownError, floor_of_residuals, noise_floor
from cell.study.data import Markers


@pytest.mark.parametrize("colour", [0.0, 0.5, 0.9])
def test_level_and_colour_are_recovered(make_study, colour):
    found = [noise_floor(make_study(seed=s, colour=colour, noise_m=2e-4)).noise for s in range(3)]
    assert np.mean([n.colour for n in found]) == pytest.approx(colour, abs=0.05)
    assert np.mean([n.std_m for n in found]) == pytest.approx(
        2e-4, rel=0.03 if colour < 0.6 else 0.1
    )


def test_a_settling_cable_does_not_count_as_noise(make_study):
    study = make_study(colour=0.0)
    drifting = []
    for trial in study.trials:
        sag = 2e-3 * np.exp(-trial.markers.t_s / 0.15)[:, None, None]
        drifting.append(
            replace(trial, markers=Markers(trial.markers.t_s, trial.markers.xy_m + sag))
        )
    found = noise_floor(replace(study, trials=tuple(drifting))).noise
    assert found.std_m == pytest.approx(1e-4, rel=0.1)
    assert found.colour < 0.2


def test_lost_frames_and_markers_cost_no_more_than_themselves(make_study):
    """Every marker lost once at rest, and all of them in one frame."""
    study = make_study(colour=0.5, noise_m=2e-4)
    gappy = []
    for trial in study.trials:
        xy_m = trial.markers.xy_m.copy()
        xy_m[5] = np.nan
        for marker in range(xy_m.shape[1]):
            xy_m[8 + marker % 3, marker] = np.nan
        gappy.append(replace(trial, markers=Markers(trial.markers.t_s, xy_m)))
    floor, whole = noise_floor(replace(study, trials=tuple(gappy))), noise_floor(study)
    assert floor.noise.std_m == pytest.approx(2e-4, rel=0.05)
    assert floor.noise.colour == pytest.approx(0.5, abs=0.1)
    assert 0.5 * whole.freedom < floor.freedom < whole.freedom


def test_a_stated_level_is_kept(make_study):
    assert noise_floor(replace(make_study(), noise_std_m=3e-4)).noise.std_m == 3e-4


def test_without_still_frames_the_level_must_be_given(make_study):
    study = make_study()
    late = [
        replace(t, markers=Markers(t.markers.t_s[50:], t.markers.xy_m[50:])) for t in study.trials
    ]
    moving = replace(study, trials=tuple(late))
    with pytest.raises(NoiseUnknownError, match="noise_std_m"):
        noise_floor(moving)
    assert noise_floor(replace(moving, noise_std_m=1e-4)).noise.std_m == 1e-4


def test_a_stated_error_is_as_correlated_as_what_a_model_leaves():
    """Shapes fitted to pictures err along the whole cable at once, and stay for some frames."""
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(3):
        shapes = np.repeat(rng.normal(size=(60, 2, 2)), 3, axis=0)
        along = np.linspace(0.1, 1.0, 6)[:, None] ** np.arange(1, 3)
        errors.append(1e-3 * np.einsum("tkc,mk->tmc", shapes, along).reshape(180, 12))
    errors[0][5:9, 3] = np.nan
    stated = Floor(Noise(1e-3, 0.9), np.inf)
    found = floor_of_residuals(stated, errors)
    assert found.noise.std_m == 1e-3
    assert found.noise.colour == pytest.approx(2.0 / 3.0, abs=0.06)
    assert 12.0 / found.together == pytest.approx(2.4, rel=0.2)  # of two shapes, two coordinates
    assert found.weighed.std_m == pytest.approx(1e-3 * np.sqrt(found.together))
    white = [1e-3 * rng.normal(size=(180, 12)) for _ in range(3)]
    alone = floor_of_residuals(replace(stated, coloured=False), white)
    assert alone.together == pytest.approx(1.0, abs=0.1)
    assert alone.noise.colour == pytest.approx(0.0, abs=0.05)
    bound = replace(stated, noise=Noise(1e-3, 0.3))
    assert floor_of_residuals(bound, errors).noise.colour == 0.3
    seen = Floor(Noise(1e-3, 0.9), 400.0)
    assert floor_of_residuals(seen, errors) == seen
