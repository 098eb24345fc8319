"""Kinematics of Universal Robots arms from their nominal dimensions.

Poses are the controller's own: six numbers, position in m and rotation vector in rad, or 4 × 4
matrices X_BT (tool in base).  A real arm's calibrated dimensions differ by a millimetre or so,
which is why these serve to judge reach and to emulate, never to measure.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import cos, sin

import cv2
import numpy as np

from drivers.interfaces import FloatArray

_Row = tuple[float, float, float, float]

_TWIST_COS = (0.0, 1.0, 1.0, 0.0, 0.0, 1.0)
_TWIST_SIN = (1.0, 0.0, 0.0, 1.0, -1.0, 0.0)
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
_ITERATIONS = 60
_LONGEST_STEP_RAD = 0.3


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
    def _rows(self) -> tuple[_Row, ...]:
        return tuple(zip(self.a_m, self.d_m, _TWIST_COS, _TWIST_SIN, strict=True))

    def forward(self, q_rad: FloatArray, X_FT: FloatArray | None = None) -> FloatArray:
        """(6,) joint angles → (4, 4) X_BT; X_FT is the tool on the flange, none = the flange."""
        X = np.array([*self._links(q_rad)[-1], _LAST_ROW])
        return X if X_FT is None else X @ X_FT

    def inverse(
        self, X_BT: FloatArray, near_rad: FloatArray, X_FT: FloatArray | None = None
    ) -> FloatArray:
        """(6,) joint angles closest along Newton's way from `near_rad` to the pose X_BT.

        raises  OutOfReachError: the pose is not met within 0.1 µm and 0.1 µrad
        """
        q = np.array(near_rad, dtype=np.float64)
        error = np.zeros(6)
        for _ in range(_ITERATIONS):
            here, jacobian = self._chain(q, X_FT)
            error[:3] = X_BT[:3, 3] - here[:3, 3]
            error[3:] = _small_rotation(X_BT[:3, :3] @ here[:3, :3].T)
            if float(error @ error) < 1e-14:
                return q
            normal = jacobian @ jacobian.T
            normal[np.diag_indices(6)] += 1e-10
            step = jacobian.T @ np.linalg.solve(normal, error)
            longest = float(np.max(np.abs(step)))
            q += step * min(1.0, _LONGEST_STEP_RAD / max(longest, 1e-300))
        x, y, z = X_BT[:3, 3]
        raise OutOfReachError(
            f"{self.name} does not reach x = {x:.4f}, y = {y:.4f}, z = {z:.4f} m in its base frame"
        )

    def _links(self, q_rad: FloatArray) -> list[tuple[_Row, _Row, _Row]]:
        """Upper three rows of the pose of the base and of the frame behind each of the 6 joints.

        In Python's own numbers: for matrices of this size numpy's calls cost more than their sums.
        """
        x: _Row = (1.0, 0.0, 0.0, 0.0)
        y: _Row = (0.0, 1.0, 0.0, 0.0)
        z: _Row = (0.0, 0.0, 1.0, 0.0)
        links = [(x, y, z)]
        for angle_rad, joint in zip(q_rad.tolist(), self._rows, strict=True):
            c, s = cos(angle_rad), sin(angle_rad)
            x, y, z = (
                _after_joint(x, joint, c, s),
                _after_joint(y, joint, c, s),
                _after_joint(z, joint, c, s),
            )
            links.append((x, y, z))
        return links

    def _chain(self, q_rad: FloatArray, X_FT: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Pose of the tool and its (6, 6) Jacobian, linear rows first."""
        links = self._links(q_rad)
        before = np.array(links[:6])
        axes, origins = before[:, :, 2], before[:, :, 3]
        X = np.array([*links[6], _LAST_ROW])
        if X_FT is not None:
            X = X @ X_FT
        arms = X[:3, 3] - origins
        linear = np.stack(
            [
                axes[:, 1] * arms[:, 2] - axes[:, 2] * arms[:, 1],
                axes[:, 2] * arms[:, 0] - axes[:, 0] * arms[:, 2],
                axes[:, 0] * arms[:, 1] - axes[:, 1] * arms[:, 0],
            ]
        )
        return X, np.vstack([linear, axes.T])

    def jacobian(self, q_rad: FloatArray, X_FT: FloatArray | None = None) -> FloatArray:
        """(6, 6) velocity of the tool (m/s, then rad/s) per joint speed, in the base frame."""
        return self._chain(q_rad, X_FT)[1]


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


def _after_joint(row: _Row, joint: _Row, c: float, s: float) -> _Row:
    """A pose's row times a joint's matrix: a, d, twist (cos, sin) and angle (c, s)."""
    r0, r1, r2, r3 = row
    a, d, ca, sa = joint
    along, across = c * r0 + s * r1, c * r1 - s * r0
    return along, ca * across + sa * r2, ca * r2 - sa * across, r3 + a * along + d * r2


def matrix_of(pose: FloatArray) -> FloatArray:
    """(6,) position and rotation vector → (4, 4)."""
    X = np.eye(4)
    X[:3, 3] = pose[:3]
    X[:3, :3] = cv2.Rodrigues(np.asarray(pose[3:6], dtype=np.float64))[0]
    return X


def pose_of(X: FloatArray) -> FloatArray:
    """(4, 4) → (6,) position and rotation vector."""
    return np.concatenate([X[:3, 3], cv2.Rodrigues(X[:3, :3])[0].ravel()])


def _small_rotation(R: FloatArray) -> FloatArray:
    """Rotation vector of R; near a half turn, where it is lost, any long step in its direction."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    if R[0, 0] + R[1, 1] + R[2, 2] > 1.0:
        return v
    return np.asarray(cv2.Rodrigues(R)[0].ravel(), dtype=np.float64)
