"""What a diagnosis is likely to say of a hidden effect."""

from __future__ import annotations

from cell.cable.effects import library
from cell.lab.next.effect_query import EffectQuery
from cell.lab.next.study_power import SizeSearch, forecast

SIZE_RAD_PER_N_M = 40.0
AMPLITUDE_M = 4e-4


def test_half_of_an_effect_is_looked_for_with_its_shape_free(fitted, linear):
    """Its fit has the shape free, too: noise hides half of the effect in more directions."""
    effect = library()["grip_compliance"]
    asked = EffectQuery(effect, effect.parameters[0], SIZE_RAD_PER_N_M)
    found = SizeSearch(fitted, asked, linear).tests(SIZE_RAD_PER_N_M)
    assert found is not None
    plain, beside = (some.stop - some.start for some, _ in found[0].detectable_at_half_size)
    assert beside == plain + len(effect.parameters) * len(fitted.prepared.study.trials)


def test_an_effect_with_a_shape_of_nothing_is_forecast(fitted, linear):
    """A stroke's phase is 0 at first: no share of that changes anything."""
    effect = library()["robot_ringing"]
    asked = EffectQuery(effect, effect.parameters[0], AMPLITUDE_M)
    assert 0.0 in asked.at(AMPLITUDE_M).values
    said = forecast(fitted, asked, linear)
    assert said.chances is not None
    assert said.chances.significant > 0.5
