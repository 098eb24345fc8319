"""Partial explanations keep their ties, and answers that a bound gave are none."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab import partial
from cell.lab.diagnose import diagnose
from cell.lab.explore import Explorer
from cell.lab.fitting import space_with
from cell.lab.leftover import Leftover
from cell.lab.partial import largest_step, tied_so_far
from cell.lab.prepared import PreparedStudy
from cell.lab.rules import DEFAULT_RULES

KNOWN = library()


@pytest.fixture(scope="module")
def partly(make_study):
    """Late pictures, a load, and something that the library lacks."""
    hidden = [
        KNOWN["camera_latency"].active(delay_s=0.02),
        KNOWN["tip_mass"].active(mass_kg=6e-5),
        KNOWN["camera_scale"].active(factor=1.01),
    ]
    study = make_study(hidden, seed=31)
    names = ("camera_latency", "robot_lag", "tip_mass")
    space = ParameterSpace.of(study.cable)
    return diagnose(Explorer(PreparedStudy.of(study), space, {n: KNOWN[n] for n in names}))


def test_an_effect_found_first_keeps_its_ties_when_a_second_is_in(partly):
    """Pictures late or a hand late: no motion from rest tells them apart."""
    found = partly.diagnosis
    assert found.verdict == "unexplained"
    named = {f.effect: f.tied_with for f in found.partial}
    assert len(named) == 2
    assert "tip_mass" in named
    assert named.get("camera_latency", ("robot_lag",)) == ("robot_lag",)
    assert named.get("robot_lag", ("camera_latency",)) == ("camera_latency",)


def test_an_answer_that_a_bound_gave_explains_nothing(partly):
    """The first step is taken as it is, and not with its effect at the parameter's bound."""
    base, first, *_ = partly.partial
    space = first.fit.space
    explorer = Explorer(partly.weighed, space_with(space, ()), {})
    assert largest_step(explorer, base, [first], 1, DEFAULT_RULES) is first
    q = first.fit.q.copy()
    q[-1] = space.high[-1]
    limited = replace(first, fit=replace(first.fit, q=q))
    assert largest_step(explorer, base, [limited], 1, DEFAULT_RULES) is None


def test_what_leaves_as_little_with_one_effect_more_is_tied_where_more_is_missing(monkeypatch):
    """A bar with 52 g at its tip: 0.32 mm with added mass, 0.41 with a tip mass, 0.30 of 0.03 mm
    of noise with a tip mass and relaxation.  Added mass alone was named.
    """
    left_mm = {
        ("added_mass",): 0.32,
        ("tip_mass",): 0.41,
        ("draught",): 0.52,
        ("air_drag",): 0.54,
        ("added_mass", "draught"): 0.30,
        ("draught", "robot_lag"): 0.45,
        ("stress_relaxation", "tip_mass"): 0.30,
        ("air_drag", "stress_relaxation"): 0.20,
    }
    fits = {
        names: SimpleNamespace(names=frozenset(names), effects=[KNOWN[n] for n in names])
        for names in left_mm
    }
    noise = SimpleNamespace(noise=SimpleNamespace(std_m=3e-5))
    explorer = SimpleNamespace(
        known=lambda: tuple(fits.values()), prepared=SimpleNamespace(floor=noise)
    )
    monkeypatch.setattr(partial, "close_rivals", lambda *args: [])
    monkeypatch.setattr(partial, "_at_bound", lambda *args: False)
    monkeypatch.setattr(
        partial,
        "leftover",
        lambda _, c: Leftover((1e-3 * left_mm[tuple(sorted(c.names))]) ** 2, 80.0),
    )
    found = fits[("added_mass",)]
    named = tied_so_far(explorer, found, KNOWN["added_mass"], DEFAULT_RULES)
    assert named == ("tip_mass",)  # draught does not; air drag is not among the nearest
    noise.noise = SimpleNamespace(std_m=3e-4)  # nothing beyond noise is left
    assert tied_so_far(explorer, found, KNOWN["added_mass"], DEFAULT_RULES) == ()
