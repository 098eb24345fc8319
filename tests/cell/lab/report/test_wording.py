"""Names and numbers in sentences are those of a person, not of the code."""

import pytest

from cell.cable.effects import library
from cell.lab.data.results import Diagnosis, Errors, RankedEffect
from cell.lab.report.tables import ranking_table
from cell.lab.report.wording import parameter_in_words, size_in_digits


@pytest.mark.parametrize(
    ("name", "unit", "words"),
    [
        ("added_mass.kg_per_m", "kg/m", "added mass (kg/m)"),
        ("hose.k_n_m2", "N·m²", "hose k (N·m²)"),
        ("grip_compliance.rad_per_n_m", "rad/(N·m)", "grip compliance (rad/(N·m))"),
        ("linear_air_drag.drag_n_s_per_m2", "N·s/m²", "linear air drag drag (N·s/m²)"),
        ("air_drag.drag_coefficient", "1", "air drag drag coefficient"),
        ("mean_rigidity", "N·m²", "mean rigidity"),
    ],
)
def test_a_parameter_has_words_and_its_unit(name: str, unit: str, words: str) -> None:
    assert parameter_in_words(name, unit) == words


def test_every_unit_in_a_name_of_the_library_is_shown_as_one() -> None:
    for effect in library().values():
        for parameter in effect.parameters:
            words = parameter_in_words(f"{effect.name}.{parameter.name}", parameter.unit)
            assert words.endswith(f" ({parameter.unit})") == (parameter.unit != "1"), words
            assert "_" not in words and "." not in words


def test_what_is_rounded_to_nothing_has_no_sign() -> None:
    ranked = RankedEffect("bending_hysteresis", -0.02, 1.0, "absent")
    found = Diagnosis(1e-4, Errors(1e-4, 1e-4), "complete", (), ranking=(ranked,))
    assert [row[1] for row in ranking_table(found).rows] == ["0.0"]


@pytest.mark.parametrize(
    ("size", "none", "shown"),
    [
        (1.001234, 1.0, "1.00123"),
        (0.99951, 1.0, "0.99951"),
        (1.2345, 1.0, "1.234"),
        (0.0123456, 0.0, "0.0123"),
        (1.0, 1.0, "1"),
    ],
)
def test_a_size_has_digits_of_what_it_is_apart_from_none(
    size: float, none: float, shown: str
) -> None:
    """The smallest camera scale that a study shows was "a factor of 1"."""
    assert size_in_digits(size, none) == shown
