"""Fits that begin from an earlier model."""

from pathlib import Path

import numpy as np
import pytest

from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.lab.data.named_effects import select_effects
from cell.lab.search.setup import fit_cache_of


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
