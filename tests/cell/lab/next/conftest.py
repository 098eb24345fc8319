"""A small study, and its baseline fitted once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cell.lab.next.linear_study import LinearStudy
from tests.cell.lab.conftest import coarse_mesh, fits_of

#: Few effects, so that a diagnosis is quick: alike, unlike and not smooth.
NAMES = ("air_drag", "linear_air_drag", "tip_mass", "natural_curvature", "grip_angle")


@pytest.fixture(scope="session")
def fitted(make_study):
    study = make_study(seed=21)
    lost = study.trials[0].markers.xy_m.copy()
    lost[40:44, 2] = float("nan")
    first = replace(study.trials[0], markers=replace(study.trials[0].markers, xy_m=lost))
    study = replace(study, trials=(first, *study.trials[1:]))
    with coarse_mesh():
        return fits_of(study, NAMES)


@pytest.fixture(scope="session")
def linear(fitted):
    return LinearStudy.of(fitted.prepared, fitted.base.fit)
