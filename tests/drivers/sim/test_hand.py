from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import Pose, Trajectory
from drivers.sim.hand import Hand


def moving_hand() -> Hand:
    hand = Hand(0.0, Pose(0.0, 0.0))
    t = np.linspace(1.0, 2.0, 1001)
    hand.extend(Trajectory(t, 0.5 * (t - 1.0), 0.0 * t, 0.0 * t))
    return hand


def test_rests_until_the_path_begins_and_after_it_ends() -> None:
    hand = moving_hand()
    assert hand.at(np.array([0.0, 0.99, 1.5, 3.0]))[:, 0] == pytest.approx([0.0, 0.0, 0.25, 0.5])
    assert hand.rests_from_s == 2.0


def test_halt_keeps_the_past_and_stops_smoothly() -> None:
    hand = moving_hand()
    hand.halt(1.5, 0.1)
    assert hand.rests_from_s == pytest.approx(1.6)
    assert hand.pose(1.4).x_m == pytest.approx(0.2)
    assert hand.pose(9.0).x_m == pytest.approx(0.25 + 0.5 * 0.1 / 2)
    t = np.linspace(1.5, 1.6, 50)
    assert np.all(np.diff(np.diff(hand.at(t)[:, 0])) < 1e-9)  # only ever slower


def test_repeated_halts_do_not_prolong_the_stop() -> None:
    hand = moving_hand()
    for k in range(20):
        hand.halt(1.5 + 0.004 * k, 0.1)
    assert hand.rests_from_s <= 1.6 + 1e-9


def test_halt_at_rest_changes_nothing() -> None:
    hand = moving_hand()
    hand.halt(2.5, 0.1)
    assert hand.rests_from_s == 2.0


def test_motion_has_both_ends_and_every_sample_between() -> None:
    motion = moving_hand().motion(0.5, 1.0105)
    assert motion.t_s[[0, -1]] == pytest.approx([0.5, 1.0105])
    assert len(motion.t_s) == 2 + 11
    assert np.all(np.diff(motion.t_s) > 0)
