"""What a diagnosis decides of drawn scores, against its own rules and against densities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from cell.cable.effects import library
from cell.lab.data.rules import DEFAULT_RULES
from cell.lab.fit.score_test import boundary_p_value
from cell.lab.fit.sensitivity import shape_count
from cell.lab.next.decisions import EffectTest, StudyConstants
from cell.lab.next.decisions import Tests as DecisionTests

GIVEN = StudyConstants(25, 9000, 9000, 0.5, 1e-4, 0.0, 1.0, 1.0)


def effect_test(name: str, inside: np.ndarray, outside: np.ndarray) -> EffectTest:
    count = len(inside)
    return EffectTest(
        library()[name],
        inside,
        outside,
        shown=outside,
        raw_m2=1e-8 * outside,
        fitted=slice(0, count),
        heldout=slice(count, 2 * count),
    )


@pytest.mark.parametrize("name", ["air_drag", "draught", "stress_relaxation", "camera_roll"])
def test_the_least_fall_is_that_of_the_rules(name: str) -> None:
    effect = library()[name]
    amplitudes = [p for p in effect.parameters if p.amplitude]
    bounded = int(len(amplitudes) == 1 and amplitudes[0].low >= amplitudes[0].default)
    test = effect_test(name, np.eye(len(amplitudes)), np.eye(len(amplitudes)))
    few = StudyConstants(25, 2, 2, 0.5, 1e-4, 0.0, 1.0, 1.0)  # BIC asks for nothing then
    least = test.least_fall(few)
    p_value = boundary_p_value(least, len(amplitudes), bounded, shape_count(effect))
    assert 25 * p_value == pytest.approx(DEFAULT_RULES.significance, rel=1e-3)
    assert test.least_fall(GIVEN) >= least


@given(st.integers(0, 10_000))
def test_the_gain_is_the_ratio_of_the_densities_of_what_is_held_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(2, 2, 4))
    inside, outside = (r @ r.T + 0.1 * np.eye(2) for r in roots)
    size, seen = rng.normal(size=(2, 2))
    test = effect_test("draught", inside, outside)
    gain = test._gain(size[None], (outside @ seen)[None])[0]
    alone = np.linalg.inv(outside)
    together = multivariate_normal(size, alone + np.linalg.inv(inside)).logpdf(seen)
    none = multivariate_normal(np.zeros(2), alone).logpdf(seen)
    assert gain == pytest.approx(together - none, rel=1e-6, abs=1e-6)


def test_an_amplitude_of_one_sign_is_nothing_on_the_other_side() -> None:
    test = effect_test("air_drag", np.array([[4.0]]), np.array([[3.0]]))
    judged = test.decide(np.array([[-30.0, -20.0], [30.0, 20.0]]), GIVEN)
    assert list(judged.significant) == [False, True]
    assert list(judged.confirmed) == [False, True]
    assert judged.chi2[0] == 0.0


def test_the_hand_s_errors_make_the_same_worth_less() -> None:
    test = effect_test("air_drag", np.array([[4.0]]), np.array([[3.0]]))
    scores = np.array([[12.0, 30.0]])
    doubtful = StudyConstants(25, 9000, 9000, 0.5, 1e-4, 0.0, 4.0, 4.0)
    assert test.decide(scores, GIVEN).significant[0]
    assert not test.decide(scores, doubtful).significant[0]


def test_without_held_out_trials_nothing_is_confirmed() -> None:
    test = effect_test("air_drag", np.array([[4.0]]), np.array([[0.0]]))
    none = StudyConstants(25, 9000, 0, 0.5, 1e-4, 0.0, 1.0, 1.0)
    judged = test.decide(np.array([[100.0, 0.0]]), none)
    assert judged.significant[0]
    assert not judged.confirmed[0]


def hidden_beside(rival: EffectTest, of_rival: tuple[float, float]) -> DecisionTests:
    """An effect of χ² 900 that held-out trials cannot show, and a rival that they confirm."""
    hidden = effect_test("air_drag", np.array([[1.0]]), np.array([[1e-3]]))
    moved = replace(rival, fitted=slice(2, 3), heldout=slice(3, 4))
    by_change = np.array([30.0, 0.03, *of_rival])
    return DecisionTests((hidden, moved), (), GIVEN, by_change, np.zeros((1, 4)))


def test_a_rival_that_explains_less_is_exchanged_for_what_cannot_be_confirmed() -> None:
    """The effect was counted as found, because it explains at least as much as what is claimed."""
    weaker = effect_test("tip_mass", np.array([[1.0]]), np.array([[1.0]]))
    said = hidden_beside(weaker, (15.0, 15.0)).chances(1.0)
    assert (said.significant, said.confirmed) == (1.0, 0.0)
    assert (said.found, said.confused, said.missed) == (0.0, (), 1.0)


def test_an_effect_tied_with_a_rival_that_is_confirmed_is_found_with_it() -> None:
    alike = effect_test("tip_mass", np.array([[1.0]]), np.array([[0.012]]))
    alike = replace(alike, shown=np.array([[1.0]]), raw_m2=np.array([[1e-8]]))
    said = hidden_beside(alike, (29.9, 0.36)).chances(1.0)
    assert (said.confirmed, said.found, said.confused) == (0.0, 1.0, ())
