from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import Pose, Trajectory
from drivers.sim.clock import SimClock
from drivers.sim.world import GripperTrajectory, SimWorld


def test_the_arm_carries_the_cable_and_the_camera_sees_it(cell, line) -> None:
    cell.gripper.grip(20.0)
    cell.arm.follow(line(dy_m=-0.05))
    cell.clock.sleep_s(1.0)
    view = cell.world.cable_shapes(np.array([cell.clock.now_s()]))
    assert view.grip[0] == pytest.approx([0.5, 0.45, 0.0], abs=1e-6)
    assert view.cables[0, -1] == pytest.approx([0.5, 0.45], abs=1e-6)
    assert view.cables[0, 0] == pytest.approx([0.4, 0.45], abs=1e-6)


def test_one_simulation_per_motion(cell, line) -> None:
    cell.gripper.grip(20.0)
    cell.camera.start(20)
    while cell.camera.read() is not None:
        pass
    assert len(cell.cable.calls) == 1
    cell.arm.follow(line(dy_m=-0.05))
    cell.camera.start(300)
    while cell.camera.read() is not None:
        pass
    assert len(cell.cable.calls) == 2
    grip, query_s = cell.cable.calls[1]
    assert grip.t_s[0] == pytest.approx(0.4)  # from the moment it was gripped
    assert query_s[0] > 0.4  # but only what is not known yet
    assert grip.t_s[0] <= query_s[0] and query_s[-1] <= grip.t_s[-1]


def test_a_stop_makes_the_simulation_untrue(cell, line) -> None:
    cell.gripper.grip(20.0)
    cell.arm.follow(line(dy_m=-0.05))
    cell.clock.sleep_s(0.2)
    before = cell.world.cable_shapes(np.array([cell.clock.now_s()])).cables
    stopped_s = cell.clock.now_s()
    cell.arm.stop("test")
    cell.clock.sleep_s(1.0)
    view = cell.world.cable_shapes(np.array([stopped_s, cell.clock.now_s()]))
    assert view.cables[0] == pytest.approx(before[0], abs=1e-9)
    assert view.cables[1, -1] == pytest.approx(view.grip[1, :2], abs=1e-9)
    assert view.grip[1, 1] > 0.45 + 0.005
    assert len(cell.cable.calls) == 2


def test_shapes_between_grid_points_are_smooth() -> None:
    """A swing of 30 Hz and 2 mm is met to a tenth of a micrometre between grid points."""

    def swing(grip: Trajectory, query_s: np.ndarray) -> np.ndarray:
        y = 0.002 * np.sin(2 * np.pi * 30.0 * query_s)
        return np.broadcast_to(y[:, None, None], (len(query_s), 60, 2)).copy()

    clock = SimClock()
    world = SimWorld(clock, Pose(0.0, 0.0))
    world.present(swing)
    world.take()
    clock.sleep_s(1.0)
    t_s = np.linspace(0.0, 1.0, 997)
    exact = 0.002 * np.sin(2 * np.pi * 30.0 * t_s)
    assert world.cable_shapes(t_s).cables[:, 0, 1] == pytest.approx(exact, abs=1e-7)


def test_the_future_cannot_be_seen(cell) -> None:
    with pytest.raises(ValueError, match=r"looked at t = 1.0"):
        cell.world.cable_shapes(np.array([1.0]))


@pytest.mark.parametrize("shape", [(3, 60, 2), (None, 59, 2), (None, 60, 3), (None, 60)])
def test_a_callable_of_wrong_shape_is_named(shape) -> None:
    def wrong(grip: Trajectory, query_s: np.ndarray) -> np.ndarray:
        return np.zeros([len(query_s) if n is None else n for n in shape])

    world = SimWorld(SimClock(), Pose(0.0, 0.0))
    world.present(wrong)
    world.take()
    with pytest.raises(ValueError, match="callable returned shape"):
        world.cable_shapes(np.array([0.0]))


def test_what_was_let_go_can_still_be_seen_in_the_past(cell) -> None:
    cell.gripper.grip(20.0)
    cell.clock.sleep_s(0.5)
    seen_s = cell.clock.now_s()
    cell.clock.sleep_s(0.1)
    cell.gripper.release()
    assert cell.world.cable_shapes(np.array([seen_s])).cables is not None
    assert cell.world.cable_shapes(np.array([cell.clock.now_s()])).cables is None


def moving_hand() -> GripperTrajectory:
    hand = GripperTrajectory(0.0, Pose(0.0, 0.0))
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
