"""Fits that begin from an earlier model; outliers that the motion hides show in the residual."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.cable.model import CableModel
from cell.cable.solver import Solver
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.lab.data.named_effects import EffectSelection, select_effects
from cell.lab.search.setup import fit_cache_of, without_outliers
from cell.study import left_out
from cell.study.data import Study, Trial
from tools.worlds.made_studies import CABLE, filmed, moved


@pytest.fixture(scope="module")
def study() -> Study:
    """A tip alone, in 40 frames a second, of a cable that swings by centimetres between two."""
    t_s = np.arange(0.0, 1.7, 0.005)
    grip, tip = moved(t_s, (0.0, -0.05), 0.2, begin_s=0.4), np.array([0.1])
    model = CableModel.uniform(CABLE, 3e-5, viscosity_n_m2_s=1e-7)
    frames = np.arange(0.0, 1.7, 0.025)
    seen = filmed(np.random.default_rng(2), model, grip, frames, tip, solver=Solver())
    trial = Trial("a", "fit", "equilibrium", grip, seen)
    return Study("s", CABLE, tip, (trial,))


@pytest.mark.usefixtures("own_mesh")
def test_an_outlier_is_left_out_and_told(study):
    trial = study.trials[0]
    xy_m = trial.markers.xy_m.copy()
    xy_m[21, 0, 1] += 1.5e-3  # while it swings
    spoilt = replace(study, trials=(replace(trial, markers=replace(trial.markers, xy_m=xy_m)),))
    assert left_out.without_outliers(spoilt).notes == ()
    cleaned, told = without_outliers(fit_cache_of(spoilt, EffectSelection((), {})))
    assert len(told) == 1 and "line 23, y0_m by +1." in told[0]
    expected = xy_m.copy()
    expected[21, 0, 1] = np.nan
    seen = cleaned.prepared.study.trials[0].markers.xy_m
    np.testing.assert_allclose(seen, expected, atol=2e-5)  # its mesh's error is taken out
    assert cleaned.base.fit.rms_m < 1.3e-4


def test_where_nothing_is_wrong_the_fits_stay_as_they_are(study):
    fits = fit_cache_of(study, EffectSelection((), {}))
    assert without_outliers(fits) == (fits, ())


def test_a_model_that_was_never_measured_says_nothing_of_the_noise(make_study):
    """Its residual of 0 was taken for noise of 0, and refused."""
    study = make_study([], seed=4)
    space = ParameterSpace.of(study.cable)
    covariance = np.linalg.inv(space.precision)
    model = Identified(
        space, space.mean, covariance, Noise(1e-4), 0.0, 1.0, 0, 0, 0, "imported", 0.0 * covariance
    )
    fits = fit_cache_of(study, select_effects([]), (Path("chain.json"), model))
    plain = fit_cache_of(study, select_effects([]))
    noises = [f.prepared.noise_model.noise.std_m for f in (fits, plain)]
    assert noises[0] == pytest.approx(noises[1])
    assert np.allclose(fits.space.mean, space.mean)
