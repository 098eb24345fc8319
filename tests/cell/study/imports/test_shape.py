"""Shapes of chains: what noise alone makes is no direction."""

from __future__ import annotations

import numpy as np
import pytest

from cell.study.imports.shape import bend, distinct_points, lost_rows, root_direction

#: A cable that droops to the left of the gripper at the origin, m.
DROOPING = np.array([[-0.02 * i, -0.001 * i**2] for i in range(6)])


def with_marker_at_the_hand(away_m: tuple[float, float]) -> np.ndarray:
    return np.insert(DROOPING, 1, away_m, axis=0)


@pytest.mark.parametrize("away_m", [(0.0, 0.0), (1e-4, 2e-4), (-5e-5, 3e-4), (2e-4, -1e-4)])
def test_a_marker_at_the_gripping_point_makes_no_direction(away_m: tuple[float, float]) -> None:
    shape = with_marker_at_the_hand(away_m)
    np.testing.assert_allclose(distinct_points(shape), DROOPING)
    np.testing.assert_allclose(root_direction(shape), root_direction(DROOPING))
    np.testing.assert_allclose(bend(shape), bend(DROOPING))
    assert bend(shape)[1] < 0.0, "it bends down"


def test_the_tip_is_kept_and_points_that_are_apart_are() -> None:
    np.testing.assert_array_equal(distinct_points(DROOPING), DROOPING)
    double = np.vstack([DROOPING, DROOPING[-1] + 1e-4])
    np.testing.assert_array_equal(distinct_points(double), np.vstack([DROOPING[:-1], double[-1]]))
    assert len(distinct_points(DROOPING[:1])) == 1 and len(distinct_points(DROOPING[:2])) == 2


T_S = np.arange(0.0, 1.0, 0.005)
X = np.clip((T_S - 0.3) / 0.25, 0.0, 1.0)
#: A gripper that rests at (0, 0), then goes down by 50.
FROM_0 = np.outer(X**3 * (10 - 15 * X + 6 * X**2), [0.0, -50.0])


def lost(hand: np.ndarray) -> list[int]:
    return np.flatnonzero(lost_rows(hand, (0.0,), of_hand=True)).tolist()


@pytest.mark.parametrize("wrong", [False, True])
def test_a_hand_may_rest_at_0_and_pass_it(wrong: bool) -> None:
    """All rows of its rest were left out, for the tip was once lost as zeros."""
    hand = FROM_0.copy()
    if wrong:
        hand[150] += 7.0
    assert lost(hand) == []
    assert lost(hand[::-1]) == []
    hand = hand - hand[90]
    assert lost(hand) == []
    assert lost_rows(hand, (0.0,), of_hand=False)[90]
    assert lost(np.zeros((9, 2))) == []


@pytest.mark.parametrize("rows", [[0, 1], [70, 71, 72, 73], [199], [5, 9, 90]])
def test_a_hand_that_jumps_there_and_back_was_lost(rows: list[int]) -> None:
    hand = FROM_0 + np.array([300.0, 500.0])
    hand[rows] = 0.0
    assert lost(hand) == rows
    hand[[row - 1 for row in rows if row]] = np.nan
    assert lost(hand) == [row for row in rows if not np.isnan(hand[row, 0])]
