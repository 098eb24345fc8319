"""Motions of the emulated arm: the change of its joints per tick."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drivers.interfaces import FloatArray
from drivers.ur_kinematics import UR5E, UrModel

#: Default initial joints of an arm.
HOME_RAD = (0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0)


@dataclass
class Joints:
    """Joint angles and speeds of an arm and the tool on its flange."""

    model: UrModel = UR5E
    q_rad: FloatArray = field(default_factory=lambda: np.array(HOME_RAD))
    qd_rad_per_s: FloatArray = field(default_factory=lambda: np.zeros(6))
    X_FT: FloatArray = field(default_factory=lambda: np.eye(4))

    @property
    def fastest_rad_per_s(self) -> float:
        """Speed of the fastest joint; numpy's own maximum of six costs ten times as much."""
        return float(max(map(abs, self.qd_rad_per_s.tolist())))

    def tool(self) -> FloatArray:
        """(4, 4) X_BT."""
        return self.model.forward(self.q_rad, self.X_FT)

    def joints_at(self, X_BT: FloatArray) -> FloatArray:
        """(6,) joint angles for a pose, near the present ones.  Raises OutOfReachError."""
        return self.model.inverse(X_BT, self.q_rad, self.X_FT)

    def tool_speed(self) -> FloatArray:
        """(6,) m/s and rad/s."""
        if not any(self.qd_rad_per_s.tolist()):
            return np.zeros(6)
        return np.asarray(
            self.model.jacobian(self.q_rad, self.X_FT) @ self.qd_rad_per_s, dtype=np.float64
        )

    def go(self, q_rad: FloatArray, step_s: float) -> None:
        """Be at `q_rad` one tick later."""
        self.qd_rad_per_s = (q_rad - self.q_rad) / step_s
        self.q_rad = q_rad

    def rest(self) -> None:
        """Stand still at once."""
        self.qd_rad_per_s = np.zeros(6)


@dataclass
class Servo:
    """servoj: follow a target that is renewed all the time, one `lookahead_s` late.

    A critically damped second-order lag, exact for a target that is constant within a tick.
    """

    target_rad: FloatArray
    lookahead_s: float

    def step(self, joints: Joints, step_s: float) -> None:
        """Move on by a tick; the speed slider does not slow a servo."""
        omega = 2.0 / max(self.lookahead_s, 0.01)
        decay = float(np.exp(-omega * step_s))
        behind: FloatArray = joints.q_rad - self.target_rad
        slope: FloatArray = joints.qd_rad_per_s + omega * behind
        behind = (behind + slope * step_s) * decay
        joints.q_rad = self.target_rad + behind
        joints.qd_rad_per_s = slope * decay - omega * behind


@dataclass
class Decelerate:
    """Come to rest with a deceleration, in the direction of motion.

    in_joints  of the norm of the joint speeds, rad/s², as by stopj; else of the tool, m/s²
    """

    deceleration: float
    in_joints: bool

    def step(self, joints: Joints, step_s: float) -> bool:
        """Move on by a tick; True until the arm rests."""
        rate = joints.qd_rad_per_s if self.in_joints else joints.tool_speed()[:3]
        speed = float(np.linalg.norm(rate))
        share = max(0.0, 1.0 - self.deceleration * step_s / speed) if speed > 1e-9 else 0.0
        joints.go(joints.q_rad + joints.qd_rad_per_s * share * step_s, step_s)
        if share == 0.0:
            joints.rest()
        return share > 0.0
