"""Replayed devices say what the recorded ones said."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import Pose, Trajectory
from drivers.replay import RecordedPoses, ReplayArm
from drivers.sim.clock import SimClock


def answer(start_s: float, end_s: float) -> RecordedPoses:
    """Poses of a time, their x as long as it lasts."""
    t_s = np.array([start_s, end_s])
    return RecordedPoses(start_s, end_s, Trajectory(t_s, t_s - start_s, np.zeros(2), np.zeros(2)))


@pytest.mark.parametrize(
    ("asked_s", "answered_s"),
    [
        (1.4, 1.4),  # until a frame
        (2.0, 3.0),  # until now: nearer to 1.4, but a computer was busy between 2.0 and 3.0
        (3.1, 9.0),
        (9.5, 9.0),
    ],
)
def test_poses_until_now_are_those_of_the_later_answer(asked_s: float, answered_s: float) -> None:
    answers = [answer(1.0, end_s) for end_s in (1.2, 1.4, 3.0, 9.0)]
    arm = ReplayArm(SimClock(0.0), Pose(0.0, 0.0, 0.0), 500.0, 0.03, answers, [])
    assert arm.log(1.0, asked_s).t_s[-1] == answered_s
    assert arm.log(0.5, 0.75).t_s[-1] == 0.75  # of another time: its own path
