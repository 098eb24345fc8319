"""Counts are recognised by their steps; the turn is followed over a whole one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cell.study.imports.capture import Capture, CapturedColumn
from cell.study.imports.encoder import count_of, place_m, turn_of
from cell.study.imports.hand_section import TurnsSection

UNIT = 2.0 * np.pi / 4096
TURNS = TurnsSection(
    column="enc", radians_per_unit=UNIT, axle_m=(0.1, 0.2), radius_m=0.5, offset_rad=0.3
)


def capture(values: np.ndarray) -> Capture:
    return Capture(
        Path("a.csv"), (CapturedColumn("enc"),), values[:, None], np.arange(len(values)) + 2
    )


@pytest.mark.parametrize(
    ("values", "count"),
    [
        ([3.0, 3.0, 4.0, 6.0, 9.0], 1.0),
        ([0.25, 0.5, 1.75, np.nan], 0.25),
        ([10.0, 14.0, 22.0], 4.0),
        ([0.0, 7.0, 15.0, 22.0], 1.0),
        ([0.1, 0.2734, 0.5, 0.61], 0.0),
        ([3.0, 4.0, 3.0], 0.0),
    ],
)
def test_counts_are_whole_multiples_of_a_step(values: list[float], count: float) -> None:
    assert count_of(np.array(values)) == pytest.approx(count)


def test_a_turn_is_followed_over_a_whole_one_within_its_counts() -> None:
    true = np.concatenate([np.zeros(50), np.linspace(0.0, 700.0, 100), np.full(50, 700.0)]) + 3900.0
    found = turn_of(capture(np.round(true) % 4096), TURNS)
    wanted = (true - 4096.0) * UNIT + 0.3
    np.testing.assert_allclose(found.angle_rad, wanted, atol=1.01 * UNIT)
    assert found.count_rad == pytest.approx(UNIT)
    assert np.std(found.angle_rad[:50]) == pytest.approx(UNIT / np.sqrt(12.0), rel=0.2)
    assert found.moves is not None
    assert 50 <= found.moves[0] < 55
    assert 145 < found.moves[1] < 150


def test_an_arm_that_does_not_move_stays() -> None:
    found = turn_of(capture(np.full(30, 100.0)), TURNS)
    assert found.moves is None
    assert np.ptp(found.angle_rad) == 0.0


def test_the_arm_points_to_the_left_and_turns_down() -> None:
    places = place_m(np.array([0.0, np.pi / 2.0]), TURNS)
    np.testing.assert_allclose(places, [[-0.4, 0.2], [0.1, -0.3]], atol=1e-12)
