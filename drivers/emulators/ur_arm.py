"""Motion of the emulated arm: the change of the joints per tick by each URScript motion."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from drivers.interfaces import FloatArray
from drivers.ur_kinematics import UR5E, UrModel
from drivers.ur_pose import matrix_of, pose_of

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
    def moves(self) -> bool:
        """Whether any joint turns, however slowly."""
        return any(self.qd_rad_per_s.tolist())

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
        if not self.moves:
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


class JointMotion(Protocol):
    """Something that moves joints until it is done."""

    def step(self, joints: Joints, step_s: float, speed_fraction: float) -> bool:
        """Move on by a tick; True while there is more to do."""
        ...


@dataclass
class Servo:
    """servoj: follow a target that is renewed all the time, one `lookahead_s` late.

    A critically damped second-order lag, exact for a target that is constant within a tick.
    """

    target_rad: FloatArray
    lookahead_s: float

    def step(self, joints: Joints, step_s: float, speed_fraction: float) -> bool:
        """Never done; the speed slider does not slow a servo."""
        omega = 2.0 / max(self.lookahead_s, 0.01)
        decay = float(np.exp(-omega * step_s))
        behind: FloatArray = joints.q_rad - self.target_rad
        slope: FloatArray = joints.qd_rad_per_s + omega * behind
        behind = (behind + slope * step_s) * decay
        joints.q_rad = self.target_rad + behind
        joints.qd_rad_per_s = slope * decay - omega * behind
        return True


@dataclass
class Speed:
    """speedl or speedj: keep a speed, reached with limited acceleration, for a time."""

    target: FloatArray
    acceleration: float
    duration_s: float
    in_joints: bool
    passed_s: float = 0.0

    def step(self, joints: Joints, step_s: float, speed_fraction: float) -> bool:
        """Done after `duration_s`, if that is not 0."""
        self.passed_s += step_s
        over = 0.0 < self.duration_s < self.passed_s
        wanted = np.zeros(6) if over else self.target * speed_fraction
        if not self.in_joints:
            jacobian = joints.model.jacobian(joints.q_rad, joints.X_FT)
            toward = np.linalg.solve(jacobian + 1e-9 * np.eye(6), wanted)
            wanted = np.asarray(toward, dtype=np.float64)
        change = self.acceleration * step_s * 4.0  # a metre turns a joint by up to 4 rad
        qd = joints.qd_rad_per_s + np.clip(wanted - joints.qd_rad_per_s, -change, change)
        joints.go(joints.q_rad + qd * step_s, step_s)
        return not (over and float(np.max(np.abs(qd))) < 1e-9)


@dataclass
class Decelerate:
    """stopl or stopj: come to rest with a deceleration, in the direction of motion."""

    deceleration: float
    in_joints: bool

    def step(self, joints: Joints, step_s: float, speed_fraction: float) -> bool:
        """Done at rest."""
        rate = joints.qd_rad_per_s if self.in_joints else joints.tool_speed()[:3]
        speed = float(np.linalg.norm(rate))
        share = max(0.0, 1.0 - self.deceleration * step_s / speed) if speed > 1e-9 else 0.0
        joints.go(joints.q_rad + joints.qd_rad_per_s * share * step_s, step_s)
        if share == 0.0:
            joints.rest()
        return share > 0.0


class _Trapezoid:
    """Way along a path of known length under limits of speed and acceleration."""

    def __init__(self, length: float, speed: float, acceleration: float) -> None:
        self.length, self.speed, self.acceleration = length, speed, acceleration
        self.way = self.rate = 0.0

    def advance(self, step_s: float, speed_fraction: float) -> float:
        """Share of the path, 0 … 1, one tick later."""
        if self.length <= 0.0:
            return 1.0
        braking = np.sqrt(2.0 * self.acceleration * max(self.length - self.way, 0.0))
        faster = self.rate + self.acceleration * step_s
        self.rate = min(faster, self.speed * speed_fraction, float(braking))
        self.way = min(self.length, self.way + max(self.rate * step_s, 1e-7))
        return 1.0 if self.length - self.way < 1e-6 else self.way / self.length


class MoveJoints:
    """movej: all joints start and arrive together."""

    def __init__(
        self, joints: Joints, q_rad: FloatArray, speed: float, acceleration: float
    ) -> None:
        self._from, self._by = joints.q_rad.copy(), q_rad - joints.q_rad
        self._profile = _Trapezoid(float(np.max(np.abs(self._by))), speed, acceleration)

    def step(self, joints: Joints, step_s: float, speed_fraction: float) -> bool:
        """Done on arrival."""
        share = self._profile.advance(step_s, speed_fraction)
        joints.go(self._from + share * self._by, step_s)
        return share < 1.0


class MoveLine:
    """movel: the tool moves along a straight line."""

    def __init__(self, joints: Joints, X_BT: FloatArray, speed: float, acceleration: float) -> None:
        self._from = joints.tool()
        turn = np.eye(4)
        turn[:3, :3] = X_BT[:3, :3] @ self._from[:3, :3].T
        self._shift, self._turn = X_BT[:3, 3] - self._from[:3, 3], pose_of(turn)[3:]
        length = max(float(np.linalg.norm(self._shift)), 0.3 * float(np.linalg.norm(self._turn)))
        self._profile = _Trapezoid(length, speed, acceleration)

    def step(self, joints: Joints, step_s: float, speed_fraction: float) -> bool:
        """Done on arrival.  Raises OutOfReachError on the way."""
        share = self._profile.advance(step_s, speed_fraction)
        X = np.eye(4)
        X[:3, 3] = self._from[:3, 3] + share * self._shift
        turned = matrix_of(np.concatenate([np.zeros(3), share * self._turn]))
        X[:3, :3] = turned[:3, :3] @ self._from[:3, :3]
        joints.go(joints.joints_at(X), step_s)
        return share < 1.0
