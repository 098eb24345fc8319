"""A value that means that a marker was lost may be a place of the hand."""

from __future__ import annotations

import numpy as np
import pytest

from cell.study.imports.lost import lost_rows

T_S = np.arange(0.0, 1.0, 0.005)
X = np.clip((T_S - 0.3) / 0.25, 0.0, 1.0)
#: A hand that rests at (0, 0), then goes down by 50.
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
