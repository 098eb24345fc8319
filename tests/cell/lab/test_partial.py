"""Partial explanations keep their ties, and answers that a bound gave are none."""

from dataclasses import replace

import pytest

from cell.cable.effects import library
from cell.identify.parameters import ParameterSpace
from cell.lab.diagnose import diagnose
from cell.lab.explore import Explorer
from cell.lab.fitting import space_with
from cell.lab.partial import largest_step
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
