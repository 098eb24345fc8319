from dataclasses import replace

import pytest

from cell.cable.effects import Effect, Parameter, library, unscreened
from cell.exchange.expressible import expressible, unseen

EXPRESSED = {
    *("air_drag", "stress_relaxation", "natural_curvature", "rest_shape"),
    *("tip_mass", "grip_angle", "grip_compliance", "grip_slip", "added_mass"),
}
ALL = library() | unscreened()


@pytest.mark.parametrize("name", sorted(ALL))
def test_every_effect_is_expressed_or_left_out_with_a_reason(flat_model, name):
    model = replace(flat_model().model, effects=(ALL[name].active(),))
    kept, left = expressible(model)
    assert [a.effect.name for a in kept.effects] == [name] * (name in EXPRESSED)
    assert [one.name for one in left] == [name] * (name not in EXPRESSED)
    assert all(one.reason for one in left)


def test_inertia_across_alone_is_left_out(flat_model):
    across = ALL["added_mass"].active(kg_per_m=1e-4, along=0.0)
    _, left = expressible(replace(flat_model().model, effects=(across,)))
    assert "across" in left[0].reason


def test_a_users_own_effect_counts_by_its_hooks(flat_model):
    class Sticker(Effect):
        name = "sticker"
        parameters = (Parameter("mass_kg", "kg", 0.0, 1.0, 0.0, (1e-5,)),)

        @staticmethod
        def tip_mass(cable, p):
            return p.mass_kg

    model = replace(flat_model().model, effects=(Sticker.active(mass_kg=2e-5),))
    kept, left = expressible(model)
    assert kept.effects == model.effects
    assert left == ()


def test_only_the_cameras_effects_are_unseen(flat_model):
    effects = tuple(ALL[n].active() for n in ("camera_latency", "bending_hysteresis"))
    seen = unseen(replace(flat_model().model, effects=effects))
    assert [a.effect.name for a in seen.effects] == ["bending_hysteresis"]
