"""A passage counts only when it was seen; its forecast's error is measured where it matters."""

from __future__ import annotations

import numpy as np
import pytest

from cell.plan.destination import Destination
from cell.plan.passage import height_at_opening_m, measured_passage

HOLE = Destination(-0.13, -0.12, -0.105, -0.095)
T_S = np.arange(0.0, 0.5, 0.005)


def level(y_m: float) -> np.ndarray:
    """Tip moving left at 0.1 m/s at a constant height, through the opening at 0.2 s."""
    return np.column_stack([-0.1 - 0.1 * T_S, np.full(len(T_S), y_m)])


def test_a_level_passage_has_the_margin_and_miss_of_its_height() -> None:
    passage = measured_passage(HOLE, T_S, level(-0.098), T_S, level(-0.0985))
    assert passage.passed
    assert passage.margin_m == pytest.approx(0.003)
    assert passage.miss_m == pytest.approx(0.002)
    assert passage.error_m == pytest.approx(0.0005)


def test_the_height_is_taken_between_the_samples_around_the_mouth() -> None:
    tip = np.array([[-0.119, -0.100], [-0.121, -0.102]])
    assert height_at_opening_m(HOLE, tip) == pytest.approx(-0.001)
    assert np.isnan(height_at_opening_m(HOLE, tip[::-1]))


def test_a_miss_says_by_how_much() -> None:
    passage = measured_passage(HOLE, T_S, level(-0.093), T_S, level(-0.093))
    assert not passage.passed
    assert passage.reason == "the tip missed the destination by 2.00 mm"
    assert passage.margin_m == pytest.approx(-0.002)


def test_errors_before_and_after_the_destination_do_not_count() -> None:
    predicted = level(-0.1)
    predicted[T_S < 0.15, 1] += 0.05
    predicted[T_S > 0.35, 1] += 0.05
    assert measured_passage(HOLE, T_S, level(-0.1), T_S, predicted).error_m < 1e-9


@pytest.mark.parametrize(("unseen", "passes"), [(3, True), (4, False)])
def test_a_tip_unseen_while_it_passes_was_not_verified(unseen: int, passes: bool) -> None:
    tip = level(-0.1)
    tip[50 : 50 + unseen] = np.nan
    passage = measured_passage(HOLE, T_S, tip, T_S, level(-0.1))
    assert passage.passed is passes
    if not passes:
        assert passage.reason == "the tip was not seen in 4 frames while it passed"


def test_a_tip_never_seen_is_not_passed() -> None:
    tip = np.full((len(T_S), 2), np.nan)
    passage = measured_passage(HOLE, T_S, tip, T_S, level(-0.1))
    assert passage.reason == "the tip was not seen during the execution"
    assert np.isnan(passage.margin_m)


def test_unseen_frames_far_from_the_destination_do_not_matter() -> None:
    tip = level(-0.1)
    tip[:20] = np.nan
    assert measured_passage(HOLE, T_S, tip, T_S, level(-0.1)).passed


def test_frames_missing_before_a_tip_that_was_near_the_mouth_earlier_still_count() -> None:
    """It hung nearer to the opening at first than in any frame of the passage."""
    tip = level(-0.1)
    tip[:5, 0] = -0.1199
    tip[38:62] = np.nan
    passage = measured_passage(HOLE, T_S, tip, T_S, level(-0.1))
    assert passage.reason == "the tip was not seen in 24 frames while it passed"


def test_frames_missing_after_the_tip_was_deep_do_not_matter() -> None:
    tip = level(-0.1)
    tip[80:, 0] = -0.125  # it swings back within the hole
    tip[65:80] = np.nan
    assert measured_passage(HOLE, T_S, tip, T_S, level(-0.1)).passed
