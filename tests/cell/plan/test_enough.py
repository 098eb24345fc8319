"""When more frames of a hold cannot change what is chosen."""

from dataclasses import replace

import numpy as np
import pytest

from cell.cable.geometry import Cable
from cell.identify.identified import Identified
from cell.identify.noise import Noise
from cell.identify.parameters import ParameterSpace
from cell.plan.choose import ChoiceOptions, Forecast, choose
from cell.plan.destination import Destination
from cell.plan.enough import SMALL_CHANGE, enough_frames, expected_change

SPACE = ParameterSpace.of(Cable(0.1, 0.0074, 0.016, 0.0001))
MEAN = SPACE.start(3e-5)
HOLE = Destination(-0.135, -0.130, -0.005, 0.005)
CERTAIN = ChoiceOptions(repeatability_m=1e-9, samples=512)


def cable(std: float) -> Identified:
    """A cable of which one coordinate is so uncertain; the model lacks nothing."""
    covariance = np.diag([std**2, *np.full(len(MEAN) - 1, 1e-12)])
    none = np.zeros_like(covariance)
    return Identified(SPACE, MEAN, covariance, Noise(5e-5), 0.0, 1.0, 250, 250, 2, "map", none)


def straight(height_m: float) -> Forecast:
    """One offset whose tip passes level at a height, and by as much higher as the coordinate is."""
    t_s = np.linspace(0.0, 1.0, 101)
    tip_m = np.column_stack([-0.1 - 0.05 * t_s, np.full(101, height_m)])
    slopes = np.zeros((1, 101, 2, len(MEAN)))
    slopes[0, :, 1, 0] = 1.0
    one = np.ones(1)
    return Forecast(0.0 * one, 0.0 * one, one, 0.0 * one, t_s, MEAN, tip_m[None], slopes)


def change(height_m: float, std_m: float, options: ChoiceOptions = CERTAIN) -> float:
    asked = straight(height_m), cable(std_m), HOLE, options
    return expected_change(choose(*asked), *asked)


def test_what_passes_by_far_does_not_change() -> None:
    assert change(0.0, 1e-3) == 0.0


@pytest.mark.parametrize("height_m", [0.0045, 0.005, 0.0055])
def test_a_known_cable_passes_or_does_not(height_m: float) -> None:
    """With probability p it will prove to pass: |known − p| is 2 p (1 − p) in the mean."""
    chance = choose(straight(height_m), cable(1e-3), HOLE, CERTAIN).best.probability
    assert change(height_m, 1e-3) == pytest.approx(2.0 * chance * (1.0 - chance), abs=0.02)


def test_of_what_is_not_the_cables_more_frames_tell_nothing() -> None:
    shaken = replace(CERTAIN, repeatability_m=1e-3)
    assert 0.1 < choose(straight(0.005), cable(1e-6), HOLE, shaken).best.probability < 0.9
    assert change(0.005, 1e-6, shaken) < 1e-3


def test_a_cable_to_be_rejected_is_worth_all_frames() -> None:
    asked = straight(0.02), cable(1e-6), HOLE, CERTAIN
    assert expected_change(choose(*asked), *asked) < SMALL_CHANGE
    assert not enough_frames(choose(*asked), *asked)


def test_enough_where_nothing_would_change_else_not() -> None:
    for std_m, enough in ((1e-4, True), (2e-3, False)):
        asked = straight(0.002), cable(std_m), HOLE, CERTAIN
        assert choose(*asked).chosen
        assert enough_frames(choose(*asked), *asked) is enough
