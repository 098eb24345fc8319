"""Measuring motions go where they are told in their time, and no faster than was reckoned."""

from __future__ import annotations

import numpy as np
import pytest

from cell.plan.measuring import Move, least_duration_s, measuring_path
from drivers.guard import ArmLimits, check_path
from drivers.interfaces import LimitError, Pose

LIMITS = ArmLimits(-0.2, 0.2, -0.2, 0.2, -1.0, 1.0, 0.6, 6.0, 250.0)
STRAIGHT = (0.6, 6.0, 250.0)


def test_moves_follow_one_another_from_rest_to_rest() -> None:
    moves = (Move(Pose(0.0, -0.05, 0.3), 0.4), Move(Pose(-0.05, -0.05, 0.3), 0.5))
    path = measuring_path(Pose(0.0, 0.0, 0.3), moves, 500.0)
    assert path.t_s[-1] == pytest.approx(0.9)
    corner = path.at(0.4)
    assert (corner.x_m, corner.y_m) == pytest.approx((0.0, -0.05), abs=1e-12)
    middle = path.at(0.2)
    assert middle.y_m == pytest.approx(-0.025, abs=1e-9), "the polynomial is symmetric"
    end = path.at(9.9)
    assert (end.x_m, end.y_m, end.angle_rad) == pytest.approx((-0.05, -0.05, 0.3))
    speed = np.hypot(np.diff(path.x_m), np.diff(path.y_m)) * 500.0
    assert speed[[0, 199, 200, -1]].max() < 1e-3 < speed.max()


def test_the_move_of_least_duration_is_just_accepted_by_the_guard() -> None:
    for way_m in (0.005, 0.05, 0.19):
        least_s = least_duration_s(way_m, STRAIGHT)
        goal = Pose(-way_m, 0.0)
        check_path(measuring_path(Pose(0.0, 0.0), [Move(goal, 1.01 * least_s)], 500.0), LIMITS)
        with pytest.raises(LimitError):
            check_path(measuring_path(Pose(0.0, 0.0), [Move(goal, 0.9 * least_s)], 500.0), LIMITS)


def test_a_duration_between_two_samples_still_ends_at_the_goal() -> None:
    path = measuring_path(Pose(0.0, 0.0), [Move(Pose(-0.01, 0.0), 0.2011)], 500.0)
    assert path.t_s[-1] == pytest.approx(0.202)
    assert path.x_m[-1] == -0.01


@pytest.mark.parametrize("moves", [(), (Move(Pose(0.1, 0.0), 0.0),)])
def test_impossible_moves_are_refused(moves: tuple[Move, ...]) -> None:
    with pytest.raises(ValueError, match="at least one"):
        measuring_path(Pose(0.0, 0.0), moves, 500.0)
