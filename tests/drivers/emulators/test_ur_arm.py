from __future__ import annotations

import numpy as np
import pytest

from drivers.emulators.ur_arm import Decelerate, Joints, MoveJoints, MoveLine, Servo, Speed

DT = 0.002


def run(motion, joints: Joints, limit: int = 5000, fraction: float = 1.0) -> int:
    for tick in range(limit):
        if not motion.step(joints, DT, fraction):
            return tick + 1
    return limit


def test_servo_follows_a_ramp_one_lookahead_late() -> None:
    joints = Joints()
    start = joints.q_rad.copy()
    rate = 0.5
    for tick in range(1, 301):
        Servo(start + rate * tick * DT, lookahead_s=0.03).step(joints, DT, 1.0)
    late_s = tick * DT - float((joints.q_rad - start)[0]) / rate
    assert late_s == pytest.approx(0.03, abs=1.5 * DT)
    assert joints.qd_rad_per_s == pytest.approx(np.full(6, rate), rel=1e-2)


def test_servo_does_not_overshoot_a_step() -> None:
    joints = Joints()
    target = joints.q_rad + 0.1
    seen = []
    for _ in range(200):
        Servo(target, 0.05).step(joints, DT, 1.0)
        seen.append(joints.q_rad[0])
    assert max(seen) <= target[0] + 1e-12
    assert seen[-1] == pytest.approx(target[0], abs=1e-5)


def test_a_line_is_straight_and_takes_its_time() -> None:
    joints = Joints()
    start = joints.tool()
    goal = start.copy()
    goal[:3, 3] += [0.0, 0.05, -0.1]
    length = float(np.hypot(0.05, 0.1))
    move, ticks = MoveLine(joints, goal, 0.25, 1.2), 1
    while move.step(joints, DT, 1.0):
        ticks += 1
        share = (joints.tool()[:3, 3] - start[:3, 3]) @ [0.0, 0.05, -0.1] / length**2
        off = joints.tool()[:3, 3] - start[:3, 3] - share * np.array([0.0, 0.05, -0.1])
        assert np.linalg.norm(off) < 1e-6
    assert joints.tool() == pytest.approx(goal, abs=1e-6)
    assert ticks * DT == pytest.approx(length / 0.25 + 0.25 / 1.2, rel=0.05)


def test_joints_arrive_together_and_the_slider_slows_them() -> None:
    goal = Joints().q_rad + np.array([0.1, -0.2, 0.3, 0.0, 0.0, 0.5])
    full, half = Joints(), Joints()
    fast = run(MoveJoints(full, goal, 1.0, 5.0), full)
    slow = run(MoveJoints(half, goal, 1.0, 5.0), half, fraction=0.5)
    assert full.q_rad == pytest.approx(goal) and half.q_rad == pytest.approx(goal)
    assert 1.5 * fast < slow < 2.1 * fast


def test_speed_is_kept_until_its_time_is_over() -> None:
    joints = Joints()
    before = joints.tool()[2, 3]
    downwards = np.array([0.0, 0.0, -0.1, 0.0, 0.0, 0.0])
    run(Speed(downwards, 2.0, 0.5, in_joints=False), joints)
    assert joints.tool()[2, 3] - before == pytest.approx(-0.05, abs=0.005)
    assert np.max(np.abs(joints.qd_rad_per_s)) < 1e-9


@pytest.mark.parametrize("in_joints", [True, False])
def test_deceleration_takes_speed_over_deceleration(in_joints) -> None:
    joints = Joints()
    joints.qd_rad_per_s = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    speed = 0.4 if in_joints else float(np.linalg.norm(joints.tool_speed()[:3]))
    ticks = run(Decelerate(2.0, in_joints), joints)
    assert ticks * DT == pytest.approx(speed / 2.0, abs=2 * DT)
    assert not np.any(joints.qd_rad_per_s)
