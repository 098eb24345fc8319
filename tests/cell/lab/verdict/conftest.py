"""Diagnoses that several modules need are made once."""

import pytest

from cell.cable.effects import library
from cell.lab.diagnosis import diagnose
from tests.cell.lab.conftest import coarse_mesh, fits_of


@pytest.fixture(scope="session")
def curved_and_loaded(make_study):
    known = library()
    hidden = [
        known["natural_curvature"].active(curvature_1_per_m=3.0, gradient_1_per_m2=-30.0),
        known["tip_mass"].active(mass_kg=3e-5),
    ]
    return make_study(hidden, seed=12)


@pytest.fixture(scope="session")
def partly_explained(curved_and_loaded):
    """The load is not in the library, the curvature is."""
    with coarse_mesh():
        return diagnose(fits_of(curved_and_loaded, ("natural_curvature", "air_drag", "grip_slip")))
