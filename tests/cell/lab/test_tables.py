"""The sentences that people read: grammar, size of numbers, and what to do next."""

import pytest

from cell.lab.results import Diagnosis, Errors, Found
from cell.lab.tables import advice, sentence


def diagnosis(verdict, *names, tied=(), noise_m=1e-4, after_m=1e-4):
    missing = tuple(Found(n, tied, 1e-9, 90.0, {}, Errors(after_m, after_m)) for n in names)
    return Diagnosis(noise_m, Errors(9e-4, 9e-4), verdict, missing)


def test_one_effect_explains_and_two_explain():
    assert "tip mass explains 100 %" in sentence(diagnosis("missing", "tip_mass"))
    both = sentence(diagnosis("missing", "tip_mass", "air_drag"))
    assert "tip mass and air drag explain 100 %" in both


def test_small_noise_is_not_rounded_to_nothing():
    said = sentence(diagnosis("unexplained", noise_m=2.4e-6))
    assert "camera noise is 0.0024 mm" in said
    assert "misses 0.90 mm" in said


@pytest.mark.parametrize(
    ("found", "says"),
    [
        (diagnosis("complete"), "Nothing"),
        (diagnosis("missing", "tip_mass"), "cell fit STUDY --effect tip_mass -o"),
        (diagnosis("missing", "tip_mass", tied=("added_mass",)), "cell suggest STUDY"),
        (diagnosis("unexplained"), "cell discover STUDY"),
        (diagnosis("cannot_tell"), "cell suggest STUDY"),
    ],
)
def test_the_advice_fits_the_verdict(found, says):
    assert says in advice(found)
