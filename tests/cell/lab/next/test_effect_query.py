"""Effects and sizes of a command line: what is meant, and what is refused with a remedy."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.cable.effects import library
from cell.lab.next.effect_query import EffectQuery, effect_queries

OWN = '''
from cell.cable.effects import Effect, Parameter


class Wind(Effect):
    """Drag."""

    name = "wind"
    parameters = (Parameter("speed_m_per_s", "m/s", -5.0, 5.0, 0.0, (0.1,)),)

    @staticmethod
    def force(cable, at, p):
        return 1e-3 * p.speed_m_per_s, 0.0
'''


def one(given_: str) -> EffectQuery:
    (asked,), _ = effect_queries([given_], [])
    return asked


def test_without_a_size_the_first_amplitude_is_asked() -> None:
    asked = one("natural_curvature")
    assert (asked.parameter.name, asked.size) == ("curvature_1_per_m", None)
    assert asked.typical == library()["natural_curvature"].parameters[0].starts[0]


def test_another_amplitude_is_asked_by_its_name_and_the_first_is_off() -> None:
    asked = one("natural_curvature.gradient_1_per_m2=-3")
    assert asked.size == -3.0
    assert asked.at(-3.0).values == (0.0, -3.0)


def test_the_shape_is_typical_and_constants_of_the_set_up_stay() -> None:
    relaxing = one("stress_relaxation=0.2").at(0.2)
    assert relaxing.values == (0.2, library()["stress_relaxation"].parameters[1].starts[0])
    scaled = one("camera_scale=1.02").at(1.02)
    assert scaled.values[1:] == tuple(p.default for p in scaled.effect.parameters[1:])


@given(st.floats(1e-6, 49.0))
def test_any_size_within_bounds_is_read(size: float) -> None:
    assert one(f"air_drag={size!r}").size == size


@pytest.mark.parametrize(
    ("given_", "says"),
    [
        ("air_dragg", "no such effect; did you mean 'air_drag'"),
        ("air_drag=60", "drag_coefficient = 60 is outside 0 … 50; give a size within"),
        ("air_drag=nan", "outside 0 … 50"),
        ("air_drag=a lot", "the size 'a lot' is no number; give drag_coefficient"),
        ("air_drag=", "the size '' is no number"),
        ("air_drag=0", "is none of the effect; give another size"),
        ("air_drag.speed=1", "air_drag has no amplitude 'speed'; give one of: drag_coefficient"),
        ("stress_relaxation.time_s=1", "no amplitude 'time_s'; give one of: fraction"),
    ],
)
def test_what_is_meant_wrongly_is_refused(given_: str, says: str) -> None:
    with pytest.raises(ValueError, match=f"{re.escape(given_)}: ") as caught:
        effect_queries([given_], [])
    assert says in str(caught.value)


def test_an_effect_cannot_be_known_and_looked_for() -> None:
    with pytest.raises(ValueError, match="part of the model by --with"):
        effect_queries(["air_drag=1"], ["air_drag"])


def test_an_effect_of_ones_own_is_among_those_looked_for(tmp_path: Path) -> None:
    file = tmp_path / "wind.py"
    file.write_text(OWN)
    (asked,), selection = effect_queries([f"{file}=0.5"], ["added_mass"])
    assert asked.size == 0.5
    assert selection.candidates["wind"] is asked.effect
    assert [e.name for e in selection.in_model] == ["added_mass"]
    (other,), _ = effect_queries([f"{file}.speed_m_per_s=0.5"], [])
    assert other.parameter.name == "speed_m_per_s"
