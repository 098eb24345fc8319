"""The test that knows the truth, beside which diagnoses are counted."""

from __future__ import annotations

import pytest

from cell.cable.effects import library
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from tools.worlds.known_truth import evidence, without_noise
from tools.worlds.made_studies import hidden, make_study


def test_what_an_effect_leaves_counts_by_the_values_that_are_independent() -> None:
    """It was counted with 0.98 of colour, which is that of what has no noise at all."""
    clean = make_study(5, [hidden(library()["air_drag"], 0.5)], noise_m=1e-9, colour=0.0)
    space = ParameterSpace.of(clean.cable)
    white, coloured, weaker = (
        evidence(without_noise(clean, noise), space)
        for noise in (Noise(1e-4), Noise(1e-4, 0.5), Noise(2e-4))
    )
    assert coloured / white == pytest.approx((1.0 - 0.5) / (1.0 + 0.5), rel=0.25)
    assert weaker / white == pytest.approx(0.25, rel=0.05)
