"""Where the cell's plane lies in a robot's base frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drivers.interfaces import FloatArray, Pose


@dataclass(frozen=True)
class PlaneMount:
    """The cell's plane P in the base frame B of a robot whose tool frame T lies in it.

    The tool frame's origin is the gripping point; its x and y axes are the plane's when the clamp
    angle is 0.

    origin_m        origin of the plane in the base frame
    x_axis, y_axis  directions of the plane's axes in the base frame, at right angles
    """

    origin_m: tuple[float, float, float]
    x_axis: tuple[float, float, float]
    y_axis: tuple[float, float, float]

    def __post_init__(self) -> None:
        x, y = np.array(self.x_axis), np.array(self.y_axis)
        lengths = np.linalg.norm(x), np.linalg.norm(y)
        if min(lengths) < 1e-9 or abs(float(x @ y)) > 1e-3 * float(np.prod(lengths)):
            raise ValueError(
                f"plane axes {self.x_axis} and {self.y_axis}: must be at right angles, not zero"
            )

    @cached_property
    def X_BP(self) -> FloatArray:  # noqa: N802  # a pose's name: P in B
        """(4, 4) plane in base; the third axis is the plane's normal."""
        x = np.array(self.x_axis) / np.linalg.norm(self.x_axis)
        y = np.array(self.y_axis) - (x @ np.array(self.y_axis)) * x
        y /= np.linalg.norm(y)
        X = np.eye(4)
        X[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
        X[:3, 3] = self.origin_m
        return X

    @cached_property
    def _X_PB(self) -> FloatArray:  # noqa: N802
        return np.asarray(np.linalg.inv(self.X_BP), dtype=np.float64)

    def to_base(self, pose: Pose) -> FloatArray:
        """(4, 4) X_BT of the tool for a pose in the plane."""
        c, s = np.cos(pose.angle_rad), np.sin(pose.angle_rad)
        X_PT = np.array(
            [
                [c, -s, 0.0, pose.x_m],
                [s, c, 0.0, pose.y_m],
                [0.0, 0.0, 1.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        return np.asarray(self.X_BP @ X_PT, dtype=np.float64)

    def to_plane(self, X_BT: FloatArray) -> Pose:
        """Pose of the tool, projected into the plane."""
        return Pose(*self.each_to_plane(X_BT[None])[0].tolist())

    def each_to_plane(self, X_BT: FloatArray) -> FloatArray:
        """(n, 4, 4) poses of the tool → (n, 3) x and y, m, and angle, rad, in the plane."""
        X_PT = self._X_PB[:2] @ X_BT
        angle = np.arctan2(X_PT[:, 1, 0], X_PT[:, 0, 0])
        return np.column_stack([X_PT[:, 0, 3], X_PT[:, 1, 3], angle])

    def off_plane(self, X_BT: FloatArray) -> tuple[float, float]:
        """Distance of the tool from the plane, m, and its tilt out of it, rad."""
        X_PT = self._X_PB @ X_BT
        tilt = float(np.arctan2(np.hypot(X_PT[0, 2], X_PT[1, 2]), X_PT[2, 2]))
        return abs(float(X_PT[2, 3])), tilt
