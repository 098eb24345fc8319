"""Beside a model of another cable nothing is called missing that this cable does without."""

from dataclasses import replace
from pathlib import Path

import pytest

from cell.cable.effects import library
from cell.lab.prior_check import asked_by_prior_only
from cell.lab.rules import DEFAULT_RULES
from cell.lab.session import EffectSelection, explorer_of, fit_study

KNOWN = library()
FEW = EffectSelection((), {n: KNOWN[n] for n in ("grip_angle", "tip_mass")})


def short(study):
    """One trial to fit, one held out."""
    roles = {t.role: t for t in study.trials}
    return replace(study, trials=(roles["fit"], roles["validate"]))


@pytest.fixture(scope="module")
def model(make_study):
    return fit_study(explorer_of(short(make_study([], seed=5)), FEW))[0]


def asked(study, model, effect):
    explorer = explorer_of(study, FEW, (Path("model.json"), model))
    base = explorer.baseline()
    (final,) = explorer.add(base, [KNOWN[effect]])
    return asked_by_prior_only(explorer, base, final, DEFAULT_RULES)


def test_an_effect_that_only_another_cables_model_asks_for_is_told(make_study, model):
    mean = model.mean.copy()
    mean[: model.space.knots] += 0.7
    study = short(make_study([], seed=5))
    assert asked(study, replace(model, mean=mean), "grip_angle") == ("grip_angle",)


def test_an_effect_that_is_all_that_sets_a_cable_apart_is_not(make_study, model):
    """Its earlier model stands, though EI(s) alone could imitate the load."""
    loaded = short(make_study([KNOWN["tip_mass"].active(mass_kg=2e-5)], seed=5))
    assert asked(loaded, model, "tip_mass") == ()
