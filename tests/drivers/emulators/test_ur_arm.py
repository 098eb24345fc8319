from __future__ import annotations

import numpy as np
import pytest

from drivers.emulators.ur_arm import Decelerate, Joints, Servo

DT = 0.002


def test_servo_follows_a_ramp_one_lookahead_late() -> None:
    joints = Joints()
    start = joints.q_rad.copy()
    rate = 0.5
    for tick in range(1, 301):
        Servo(start + rate * tick * DT, lookahead_s=0.03).step(joints, DT)
    late_s = tick * DT - float((joints.q_rad - start)[0]) / rate
    assert late_s == pytest.approx(0.03, abs=1.5 * DT)
    assert joints.qd_rad_per_s == pytest.approx(np.full(6, rate), rel=1e-2)


def test_servo_does_not_overshoot_a_step() -> None:
    joints = Joints()
    target = joints.q_rad + 0.1
    seen = []
    for _ in range(200):
        Servo(target, 0.05).step(joints, DT)
        seen.append(joints.q_rad[0])
    assert max(seen) <= target[0] + 1e-12
    assert seen[-1] == pytest.approx(target[0], abs=1e-5)


@pytest.mark.parametrize("in_joints", [True, False])
def test_deceleration_takes_speed_over_deceleration(in_joints) -> None:
    joints = Joints()
    joints.qd_rad_per_s = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    speed = 0.4 if in_joints else float(np.linalg.norm(joints.tool_speed()[:3]))
    stop, ticks = Decelerate(2.0, in_joints), 1
    while stop.step(joints, DT):
        ticks += 1
    assert ticks * DT == pytest.approx(speed / 2.0, abs=2 * DT)
    assert not np.any(joints.qd_rad_per_s)
