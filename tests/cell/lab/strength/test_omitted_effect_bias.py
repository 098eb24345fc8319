"""Intervals of a model that lacks an effect hold what the parameters would be with it."""

from dataclasses import replace

import pytest

from cell.api.lab import fit_study
from cell.cable.effects import library
from cell.lab.data.named_effects import EffectSelection
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict.doubts import lacking_doubt
from tests.cell.lab.conftest import LONG

KNOWN = library()
FEW = ("air_drag", "tip_mass", "added_mass", "camera_scale", "draught")
#: The conftest's cables: N, and the viscosity in N·m²·s.
TRUE = {"exponent": 1.05, "viscosity": 1e-7}


def fitted(study, offered=FEW):
    """The model of a study's first two trials that knows of no effect."""
    study = replace(study, trials=study.trials[:2])
    return fit_study(fit_cache_of(study, EffectSelection((), {n: KNOWN[n] for n in offered})))[0]


def held(model):
    """The names of the true parameters, N and viscosity, that the intervals hold."""
    low, high = model.interval()
    at = {name: i for i, name in enumerate(model.space.names)}
    return {name for name, true in TRUE.items() if low[at[name]] <= true <= high[at[name]]}


@pytest.fixture(scope="module")
def dragged(make_study):
    return make_study([KNOWN["air_drag"].active(drag_coefficient=2.0)], seed=5)


def test_what_a_missing_effect_did_to_the_parameters_is_in_their_intervals(dragged):
    assert not held(fitted(dragged, offered=()))
    model = fitted(dragged)
    assert model.lacks[0] == "air_drag"
    assert held(model) == set(TRUE)
    assert "air_drag" in lacking_doubt(model.lacks)[0].message


def test_an_effect_that_nobody_knows_leaves_wider_intervals_too(dragged):
    without = fitted(dragged, offered=[n for n in FEW if n != "air_drag"])
    assert without.lacks
    assert held(without)


def test_a_complete_model_is_as_sure_as_noise_lets_it_be(make_study):
    study = make_study([], seed=6, **LONG)
    model, alone = fitted(study), fitted(study, offered=())
    assert model.lacks == ()
    assert model.covariance == pytest.approx(alone.covariance, rel=1e-3)
    assert held(model) == set(TRUE)
    assert not lacking_doubt(model.lacks)
