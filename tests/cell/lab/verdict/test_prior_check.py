"""Beside a model of another cable nothing is called missing that this cable does without."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from cell.api.lab import fit_study
from cell.cable.effects import library
from cell.lab.data.named_effects import EffectSelection
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.search.setup import fit_cache_of
from cell.lab.verdict import prior_check
from cell.lab.verdict.checks import explains
from cell.lab.verdict.evidence import Evidence
from cell.lab.verdict.prior_check import prior_driven_effects, unconfirmed_without_prior

KNOWN = library()
FEW = EffectSelection((), {n: KNOWN[n] for n in ("grip_angle", "tip_mass")})


def short(study):
    """One trial to fit, one held out."""
    roles = {t.role: t for t in study.trials}
    return replace(study, trials=(roles["fit"], roles["validate"]))


@pytest.fixture(scope="module")
def model(make_study):
    return fit_study(fit_cache_of(short(make_study([], seed=5)), FEW))[0]


def asked(study, model, effect):
    fits = fit_cache_of(study, FEW, (Path("model.json"), model))
    (final,) = fits.fit_extended(fits.base, [KNOWN[effect]])
    return prior_driven_effects(Evidence(fits, final), explains)


def test_an_effect_that_only_another_cables_model_asks_for_is_told(make_study, model):
    mean = model.mean.copy()
    mean[: model.space.knots] += 0.7
    study = short(make_study([], seed=5))
    assert asked(study, replace(model, mean=mean), "grip_angle") == ("grip_angle",)


def test_an_effect_that_is_all_that_sets_a_cable_apart_is_not(make_study, model):
    """Its earlier model stands, though EI(s) alone could imitate the load."""
    loaded = short(make_study([KNOWN["tip_mass"].active(mass_kg=2e-5)], seed=5))
    assert asked(loaded, model, "tip_mass") == ()


@pytest.mark.parametrize(
    ("named", "not_borne", "told"),
    [
        (("tip_mass",), ("tip_mass",), ()),
        (("tip_mass", "grip_angle"), ("tip_mass",), ()),
        (("added_mass", "grip_angle"), ("added_mass", "grip_angle"), ("added_mass", "grip_angle")),
    ],
)
def test_of_several_effects_a_prior_may_ask_for_one_alone(monkeypatch, named, not_borne, told):
    """A mass, a curvature and a relaxation brought a complete study back to a threefold EI."""
    monkeypatch.setattr(prior_check, "_agrees_with_prior", lambda *_: True)
    monkeypatch.setattr(prior_check, "_without_prior", lambda fits: fits)
    monkeypatch.setattr(prior_check, "unconfirmed_without_prior", lambda *_: not_borne)
    final = SimpleNamespace(effects=tuple(KNOWN[n] for n in named))
    fits = SimpleNamespace(prior_q=[0.0], added=lambda found: found.effects, base=None)
    assert prior_driven_effects(Evidence(fits, final), explains) == told


def test_an_effect_in_whose_place_another_explains_more_without_the_prior_is_told(monkeypatch):
    """Held at another angle, a cable was said to have a compliant grip, beside another's model.

    Without the prior the grip left 1.03 times the noise, and Δχ² = 190 more than the angle.
    """

    def fitted(*names, chi2):
        fit = SimpleNamespace(rms_m=1e-4)
        return SimpleNamespace(
            names=frozenset(names), chi2=chi2, fit=fit, heldout=None, evidence=-chi2
        )

    base, grip = fitted(chi2=18000.0), fitted("grip_compliance", chi2=13237.0)
    angle, roll = fitted("grip_angle", chi2=13047.0), fitted("camera_roll", chi2=13300.0)
    prepared = SimpleNamespace(
        noise_model=SimpleNamespace(noise=SimpleNamespace(std_m=1e-4)), noise_m=lambda _: 1e-4
    )
    alone = SimpleNamespace(
        prepared=prepared,
        base=base,
        fit_reduced=lambda *_: base,
        extended=lambda _: [grip, angle, roll],
        fit_extended=lambda *_: [grip],
        rules=DEFAULT_RULES,
    )

    def explained(evidence):
        return evidence.final is not base

    named = [KNOWN["grip_compliance"]]
    assert unconfirmed_without_prior(alone, named, {}, explained) == ("grip_compliance",)
    ties = {"grip_compliance": ("grip_angle",)}
    assert unconfirmed_without_prior(alone, named, ties, explained) == ()
    angle.chi2 = 13250.0  # no tie
    assert unconfirmed_without_prior(alone, named, {}, explained) == ()
