"""Delays of a cycle's own motion against those that were calibrated."""

from __future__ import annotations

import numpy as np
import pytest

from cell.run.clocks import CalibratedDelays, delay_checks
from drivers.interfaces import Trajectory
from drivers.servo import servo_response

KNOWN = CalibratedDelays(1e-4, 2e-4, 1e-3, "run `cell calibrate time`")
LAG_S = 0.03


def checks(late_s: float = 0.0, later_s: float = 0.0, frames: int = 300, stretched: float = 1.0):
    """Those of a gripper that goes down by 50 mm in 0.3 s, seen at 200 Hz."""
    t_s = np.arange(0.0, 0.3001, 0.002)
    way = (t_s / 0.3) ** 3 * (10.0 - 15.0 * t_s / 0.3 + 6.0 * (t_s / 0.3) ** 2)
    told = Trajectory(1.0 + t_s, 0.0 * t_s, -0.05 * way, 0.0 * t_s)
    true = servo_response(told, LAG_S + later_s)
    log_s = np.arange(0.8, 2.6, 0.002)
    rng = np.random.default_rng(3)
    y_m = np.interp(log_s, true.t_s, true.y_m) + rng.normal(0.0, 1e-5, len(log_s))
    hand = Trajectory(log_s, 0.0 * log_s, y_m, 0.0 * log_s)
    exposed_s = 0.9 + 0.005 * np.arange(frames)
    seen_m = np.column_stack(
        [np.full(frames, 1e-3), stretched * np.interp(exposed_s, true.t_s, true.y_m)]
    )
    return delay_checks(exposed_s + late_s, seen_m, hand, told, LAG_S, KNOWN)


@pytest.mark.parametrize(
    ("late_s", "later_s", "right"),
    [
        (0.0, 0.0, [True, True]),
        (0.0008, -0.0008, [True, True]),
        (0.003, 0.0, [False, True]),
        (-0.002, 0.0, [False, True]),
        (0.0, 0.002, [True, False]),
        (0.1, 0.0, [False, True]),
    ],
)
def test_a_delay_that_changed_is_told_with_its_remedy(late_s, later_s, right):
    found = checks(late_s, later_s)
    assert [check.right for check in found] == right
    assert [check.found for check in found] == pytest.approx([late_s, later_s], abs=2e-4)
    assert all(check.remedy == KNOWN.remedy for check in found)
    assert all(1e-3 < check.high < 1.5e-3 for check in found)


def test_a_jaw_that_is_hardly_seen_says_nothing():
    assert checks(frames=20) == ()


def test_a_map_that_is_wrong_is_not_taken_for_a_delay():
    late, lag = checks(stretched=1.1)
    assert late.right
    assert late.what.endswith("not measurable with this motion")
    assert lag.high is not None
