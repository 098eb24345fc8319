"""Kinematics of Universal Robots arms from their nominal dimensions.

Poses are 4 × 4 matrices X_BT (tool in base), m; see `drivers.ur_kinematics`.  Compiled: an emulated
controller works the joints out in each of its cycles, 500 times a second.  A real arm's calibrated
dimensions differ by a millimetre or so, which is why these serve to judge reach and to emulate,
never to measure.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import atan2, cos, sin, sqrt

import numpy as np
from numba import njit

from drivers.interfaces import FloatArray, LimitError, Trajectory
from drivers.plane_mount import PlaneMount

_TWIST_COS = (0.0, 1.0, 1.0, 0.0, 0.0, 1.0)
_TWIST_SIN = (1.0, 0.0, 0.0, 1.0, -1.0, 0.0)
_FLANGE = np.eye(4)
_ITERATIONS = 60
_LONGEST_STEP_RAD = 0.3
_MET = 1e-14  # square of 0.1 µm and 0.1 µrad
_HALF_TURN = 1e-9  # sine of an angle that is as good as π


class OutOfReachError(ValueError):
    """No joint angles put the tool there."""


@dataclass(frozen=True)
class UrModel:
    """Denavit–Hartenberg lengths of an arm, m (Universal Robots, "DH parameters for calculations").

    a_m, d_m   (6,) link lengths and offsets
    max_joint_speed_rad_per_s  of the slowest joint
    """

    name: str
    a_m: tuple[float, ...]
    d_m: tuple[float, ...]
    max_joint_speed_rad_per_s: float

    @cached_property
    def _joints(self) -> FloatArray:
        """(6, 4) a, d, m, and cosine and sine of the twist of each joint."""
        return np.column_stack([self.a_m, self.d_m, _TWIST_COS, _TWIST_SIN])

    def forward(self, q_rad: FloatArray, X_FT: FloatArray | None = None) -> FloatArray:
        """(6,) joint angles → (4, 4) X_BT; X_FT is the tool on the flange, none = the flange."""
        return self._chain(q_rad, X_FT)[0]

    def forward_each(self, q_rad: FloatArray, X_FT: FloatArray | None = None) -> FloatArray:
        """(n, 6) joint angles → (n, 4, 4) X_BT."""
        X = np.empty((len(q_rad), 4, 4))
        _follow_each(np.array(q_rad, dtype=np.float64), self._joints, _tool(X_FT), X)
        return X

    def jacobian(self, q_rad: FloatArray, X_FT: FloatArray | None = None) -> FloatArray:
        """(6, 6) velocity of the tool (m/s, then rad/s) per joint speed, in the base frame."""
        return self._chain(q_rad, X_FT)[1]

    def inverse(
        self, X_BT: FloatArray, near_rad: FloatArray, X_FT: FloatArray | None = None
    ) -> FloatArray:
        """(6,) joint angles closest along Newton's way from `near_rad` to the pose X_BT.

        raises  OutOfReachError: the pose is not met within 0.1 µm and 0.1 µrad
        """
        q = np.array(near_rad, dtype=np.float64)
        if _newton(q, np.array(X_BT, dtype=np.float64), self._joints, _tool(X_FT)):
            return q
        x, y, z = X_BT[:3, 3]
        raise OutOfReachError(
            f"{self.name} does not reach x = {x:.4f}, y = {y:.4f}, z = {z:.4f} m in its base frame"
        )

    def _chain(self, q_rad: FloatArray, X_FT: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Pose of the tool and its (6, 6) Jacobian, linear rows first."""
        X, jacobian = np.empty((4, 4)), np.empty((6, 6))
        _follow_chain(np.array(q_rad, dtype=np.float64), self._joints, _tool(X_FT), X, jacobian)
        return X, jacobian


UR3E = UrModel(
    "UR3e",
    (0.0, -0.24355, -0.2132, 0.0, 0.0, 0.0),
    (0.15185, 0.0, 0.0, 0.13105, 0.08535, 0.0921),
    3.141,
)
UR5E = UrModel(
    "UR5e",
    (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0),
    (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996),
    3.141,
)
UR10E = UrModel(
    "UR10e",
    (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0),
    (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655),
    2.094,
)
MODELS = {model.name: model for model in (UR3E, UR5E, UR10E)}


def load_code() -> None:
    """Load the machine code, or compile it: no motion can wait for that."""
    bent = np.array([0.1, -1.2, 1.3, -0.4, 0.5, 0.6])
    UR5E.inverse(UR5E.forward(bent), bent + 0.01)
    UR5E.forward_each(bent[None])


def _tool(X_FT: FloatArray | None) -> FloatArray:
    return _FLANGE if X_FT is None else np.array(X_FT, dtype=np.float64)


@njit(cache=True)
def _follow_chain(q_rad, joints, X_FT, X, jacobian):  # type: ignore[no-untyped-def]
    """Fill X (4, 4) with the tool's pose, jacobian (6, 6) with its velocity per joint speed."""
    here = np.eye(4)
    axes, origins = np.empty((6, 3)), np.empty((6, 3))
    for j in range(6):
        axes[j], origins[j] = here[:3, 2], here[:3, 3]
        a, d, ca, sa = joints[j]
        c, s = cos(q_rad[j]), sin(q_rad[j])
        for row in range(3):
            r0, r1, r2 = here[row, 0], here[row, 1], here[row, 2]
            along, across = c * r0 + s * r1, c * r1 - s * r0
            here[row, 0], here[row, 1] = along, ca * across + sa * r2
            here[row, 2] = ca * r2 - sa * across
            here[row, 3] += a * along + d * r2
    X[:] = here @ X_FT
    for j in range(6):
        jacobian[:3, j] = np.cross(axes[j], X[:3, 3] - origins[j])
        jacobian[3:, j] = axes[j]


@njit(cache=True)
def _follow_each(q_rad, joints, X_FT, X):  # type: ignore[no-untyped-def]
    """Fill X (n, 4, 4) with the tool's poses at (n, 6) joint angles."""
    jacobian = np.empty((6, 6))
    for k in range(len(q_rad)):
        _follow_chain(q_rad[k], joints, X_FT, X[k], jacobian)


@njit(cache=True)
def _newton(q, X_BT, joints, X_FT):  # type: ignore[no-untyped-def]
    """Move q (6,) rad, in place, until the tool is at X_BT; whether it got there."""
    here, jacobian, error = np.empty((4, 4)), np.empty((6, 6)), np.empty(6)
    for _ in range(_ITERATIONS):
        _follow_chain(q, joints, X_FT, here, jacobian)
        error[:3] = X_BT[:3, 3] - here[:3, 3]
        error[3:] = _rotation_vector(X_BT[:3, :3].copy() @ here[:3, :3].copy().T)
        if error @ error < _MET:
            return True
        normal = jacobian @ jacobian.T
        for i in range(6):
            normal[i, i] += 1e-10
        step = jacobian.T @ np.linalg.solve(normal, error)
        longest = np.abs(step).max()
        q += step * min(1.0, _LONGEST_STEP_RAD / max(longest, 1e-300))
    return False


@njit(cache=True)
def _rotation_vector(R):  # type: ignore[no-untyped-def]
    """(3,) axis times angle, rad, of a rotation matrix."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = sqrt(v @ v), 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    if sine > _HALF_TURN:
        return v * (atan2(sine, cosine) / sine)
    if cosine > 0.0:
        return v
    # half a turn: R = 2 n nᵀ − 1, so the column of its greatest diagonal element is along the axis
    k = np.argmax(np.array([R[0, 0], R[1, 1], R[2, 2]]))
    axis = R[:, k].copy()
    axis[k] += 1.0
    return axis * (np.pi / sqrt(axis @ axis))


_NOTHING_MOVED = "nothing was moved"

#: Between two places at which the joints are looked at: at most this time, s, or this way, m (a
#: turn of 1 rad counts as 0.1 m), whichever is longer.
STEP_S, STEP_M = 0.02, 0.002


def check_reach(
    path: Trajectory,
    q_rad: FloatArray,
    model: UrModel,
    X_FT: FloatArray,
    mount: PlaneMount,
    device: str = "arm",
) -> None:
    """Joint angles and speeds along a path whose times count from 0.

    q_rad   (6,) joint angles now, near which those of the path are looked for
    X_FT    (4, 4) tool on the flange
    raises  LimitError: out of reach, or a joint too fast; with the time of the first such place
    """
    before_s = None
    for t_s in _places_s(path).tolist():
        try:
            q_next = model.inverse(mount.to_base(path.at(t_s)), q_rad, X_FT)
        except OutOfReachError as error:
            raise LimitError(device, f"at t = {t_s:.3f} s {error}", _NOTHING_MOVED) from error
        if before_s is not None:
            fastest = float(np.max(np.abs(q_next - q_rad))) / (t_s - before_s)
            if fastest > model.max_joint_speed_rad_per_s:
                raise LimitError(
                    device,
                    f"at t = {t_s:.3f} s a joint turns at {fastest:.2f} rad/s, allowed "
                    f"{model.max_joint_speed_rad_per_s:.2f} rad/s",
                    _NOTHING_MOVED,
                )
        before_s, q_rad = t_s, q_next


def _places_s(path: Trajectory) -> FloatArray:
    """(n,) times at which the joints are looked at, the first and the last of the path included.

    Counted along the path, so that a rest in it takes no places from a fast part.
    """
    turns = 0.1 * np.diff(path.angle_rad)
    ways_m = np.hypot(np.hypot(np.diff(path.x_m), np.diff(path.y_m)), turns)
    steps = np.minimum(np.diff(path.t_s) / STEP_S, ways_m / STEP_M)
    done = np.concatenate([[0.0], np.cumsum(steps)])
    count = max(1, int(np.ceil(done[-1])))
    inner = np.interp(np.linspace(0.0, done[-1], count + 1)[1:-1], done, path.t_s)
    return np.concatenate([path.t_s[:1], inner, path.t_s[-1:]])
