from __future__ import annotations

import numpy as np
import pytest

from drivers.interfaces import ConnectError, DeviceLostError, DeviceTimeoutError, GripError
from drivers.sim.gripper import GripperFaults


def test_three_cables_in_a_row(cell) -> None:
    cell.world.present(cell.cable)
    cell.world.present(cell.cable)
    for left in (2, 1, 0):
        assert cell.gripper.grip(20.0).holding
        assert cell.world.waiting == left
        assert not cell.gripper.release().holding
    with pytest.raises(GripError, match="nothing between the jaws"):
        cell.gripper.grip(20.0)


def test_a_missed_cable_is_still_there_for_the_next_attempt(cell) -> None:
    cell.gripper.faults = GripperFaults(misses=True)
    with pytest.raises(GripError):
        cell.gripper.grip(20.0)
    assert not cell.gripper.state().holding
    cell.gripper.faults = GripperFaults()
    cell.gripper.release()
    assert cell.gripper.grip(20.0).holding


def test_a_cable_that_slips_is_gone_from_then_on(cell) -> None:
    cell.gripper.grip(20.0)
    cell.gripper.faults = GripperFaults(slips_at_s=1.0)
    cell.clock.sleep_s(0.5)
    before_s = cell.clock.now_s()
    assert cell.gripper.state().holding
    cell.clock.sleep_s(0.5)
    assert not cell.gripper.state().holding
    assert cell.world.cable_shapes(np.array([before_s])).cables is not None
    assert cell.world.cable_shapes(np.array([cell.clock.now_s()])).cables is None


def test_a_cable_that_slides_is_longer_in_the_picture(cell) -> None:
    cell.gripper.grip(20.0)
    cell.gripper.faults = GripperFaults(slides_at_s=0.6, slides_m=0.004)
    cell.clock.sleep_s(0.5)
    assert cell.gripper.state().holding
    cable = cell.world.cable_shapes(np.array([cell.clock.now_s()])).cables[0]
    assert np.linalg.norm(np.diff(cable, axis=0), axis=1).sum() == pytest.approx(0.104)
    assert cable[-1] == pytest.approx([0.5, 0.5])


def test_jammed_jaws_time_out(cell) -> None:
    cell.gripper.faults = GripperFaults(jams=True)
    with pytest.raises(DeviceTimeoutError, match=r"within 3.0 s"):
        cell.gripper.grip(20.0)
    assert cell.clock.now_s() == pytest.approx(3.0)


def test_a_gripper_lost_while_closing_says_so_and_can_be_reconnected(cell) -> None:
    cell.gripper.faults = GripperFaults(lost_at_s=0.1)
    with pytest.raises(DeviceLostError):
        cell.gripper.grip(20.0)
    with pytest.raises(ConnectError):
        cell.gripper.connect()
    cell.gripper.faults = GripperFaults()
    cell.gripper.connect()
    assert cell.gripper.grip(20.0).holding


def test_a_replaced_fault_does_not_happen(cell) -> None:
    cell.gripper.grip(20.0)
    cell.gripper.faults = GripperFaults(slips_at_s=1.0)
    cell.gripper.faults = GripperFaults()
    cell.clock.sleep_s(2.0)
    assert cell.gripper.state().holding
