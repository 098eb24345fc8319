"""Shapes of chains: what noise alone makes is no direction."""

from __future__ import annotations

import numpy as np
import pytest

from cell.study.imports.shape import apart, bend, root_direction

#: A cable that droops to the left of the hand at the origin, m.
DROOPING = np.array([[-0.02 * i, -0.001 * i**2] for i in range(6)])


def with_marker_at_the_hand(away_m: tuple[float, float]) -> np.ndarray:
    return np.insert(DROOPING, 1, away_m, axis=0)


@pytest.mark.parametrize("away_m", [(0.0, 0.0), (1e-4, 2e-4), (-5e-5, 3e-4), (2e-4, -1e-4)])
def test_a_marker_at_the_gripping_point_makes_no_direction(away_m: tuple[float, float]) -> None:
    shape = with_marker_at_the_hand(away_m)
    np.testing.assert_allclose(apart(shape), DROOPING)
    np.testing.assert_allclose(root_direction(shape), root_direction(DROOPING))
    np.testing.assert_allclose(bend(shape), bend(DROOPING))
    assert bend(shape)[1] < 0.0, "it bends down"


def test_the_tip_is_kept_and_points_that_are_apart_are() -> None:
    np.testing.assert_array_equal(apart(DROOPING), DROOPING)
    double = np.vstack([DROOPING, DROOPING[-1] + 1e-4])
    np.testing.assert_array_equal(apart(double), np.vstack([DROOPING[:-1], double[-1]]))
    assert len(apart(DROOPING[:1])) == 1 and len(apart(DROOPING[:2])) == 2
