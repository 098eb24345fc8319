"""A path is left for rest within the limits, wherever it is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cell.plan.paths import MotionLimits, insertion_path, path_to_rest
from drivers.guard import ArmLimits, check_path
from drivers.interfaces import Pose

BRISK = MotionLimits()
ALLOWED = ArmLimits(-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 0.6, 6.0, 250.0)
PATH = insertion_path(Pose(0.0, -0.05), 0.02, 0.05, MotionLimits(0.2, 1.0, 10.0), 500.0)


@given(st.floats(0.0, float(PATH.t_s[-1]) - 0.006))
def test_it_is_the_path_until_then_and_rests_soon_after(from_s: float) -> None:
    stopped = path_to_rest(PATH, from_s, BRISK)
    same = int(np.searchsorted(PATH.t_s, from_s))
    np.testing.assert_array_equal(stopped.x_m[:same], PATH.x_m[:same])
    np.testing.assert_array_equal(stopped.y_m[:same], PATH.y_m[:same])
    assert stopped.t_s[-1] < from_s + 0.15
    check_path(stopped, ALLOWED)
    assert stopped.x_m.min() >= PATH.x_m.min() - 1e-6


def test_what_has_ended_is_not_left() -> None:
    with pytest.raises(ValueError, match="the path ends"):
        path_to_rest(PATH, float(PATH.t_s[-1]) + 0.1, BRISK)


@pytest.mark.parametrize("from_s", np.arange(0.02, 0.4, 0.02))
def test_a_hand_never_goes_back_though_the_path_is_brisker_than_the_limits(from_s: float) -> None:
    brisk = MotionLimits(0.5, 5.0, 200.0)
    gentle = MotionLimits(0.3, 1.0, 20.0)
    path = insertion_path(Pose(0.0, -0.05), 0.02, 0.05, brisk, 500.0)
    stopped = path_to_rest(path, min(from_s, float(path.t_s[-1]) - 0.006), gentle)
    assert np.diff(stopped.x_m).max() < 1e-5
    assert np.diff(stopped.y_m).max() < 1e-5
    check_path(stopped, ALLOWED)
