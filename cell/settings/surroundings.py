"""Where a gripper and its cable may be: limits, the picture's edge and the workpiece of a cell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.plane import PlaneView
from cell.cable.arrays import FloatArray
from cell.settings import Settings, load_settings
from cell.settings.calibrated import calibrated
from cell.settings.loading import load_product
from cell.vision.marks import JawMarks

Range = tuple[float, float]

#: Least distance of visible parts from the picture's edge, px.
EDGE_PX = 10.0
#: Margin of the gripper to its limits, m and rad, for the arm's tracking error; ten times the
#: tolerance of its guard.
LIMIT_MARGIN_M, LIMIT_MARGIN_RAD = 0.001, 0.01
#: Least distance from the workpiece, m.
CLEARANCE_M = 0.005


@dataclass(frozen=True)
class Surroundings:
    """Limits of the gripper in the cell's plane, the picture and the workpiece.

    home          pose in which a cable is grasped: x, y, m, and clamp angle, rad
    x_m, y_m, angle_rad   of the gripper
    picture_m     (2, 2) x and y of the camera's view, without its edge; None = not known
    workpiece_m   x of the workpiece, assumed to fill everything left of it; None = none
    frame_rate_hz of the camera; None = as in the study
    """

    home: tuple[float, float, float] = (0.0, 0.0, 0.0)
    x_m: Range = (-0.1, 0.1)
    y_m: Range = (-0.1, 0.1)
    angle_rad: Range = (-1.6, 1.6)
    velocity_m_per_s: float = 0.5
    acceleration_m_per_s2: float = 5.0
    jerk_m_per_s3: float = 200.0
    picture_m: tuple[Range, Range] | None = None
    workpiece_m: float | None = None
    frame_rate_hz: float | None = None

    @staticmethod
    def of(settings: Settings, view: PlaneView) -> Surroundings:
        """Surroundings of a cell, with the map of its camera."""
        limits, home, camera = settings.limits, settings.motion.home, settings.camera
        return Surroundings(
            home=(home.x_m, home.y_m, home.angle_rad),
            x_m=limits.x_m,
            y_m=limits.y_m,
            angle_rad=limits.angle_rad,
            velocity_m_per_s=limits.velocity_m_per_s,
            acceleration_m_per_s2=limits.acceleration_m_per_s2,
            jerk_m_per_s3=limits.jerk_m_per_s3,
            picture_m=pictured(view, camera.width_px, camera.height_px),
            workpiece_m=settings.destination.x_m[1],
            frame_rate_hz=camera.frame_rate_hz,
        )

    @staticmethod
    def read(config: Path | None, product: str | None = None) -> Surroundings:
        """Surroundings of the cell with these settings, for a product; without settings a safe box.

        raises  InputError
        """
        if config is None:
            return Surroundings()
        settings = load_settings(config) if product is None else load_product(config, product)
        return Surroundings.of(settings, calibrated(settings, config).view)

    def allows(self, angle_rad: float) -> bool:
        """Whether a clamp angle is inside its limits by the margin, or is that of home."""
        low, high = self.angle_rad
        inside = low + LIMIT_MARGIN_RAD <= angle_rad <= high - LIMIT_MARGIN_RAD
        return inside or angle_rad == self.home[2]

    def start_range(self, swept: Swept, way_m: tuple[float, float]) -> tuple[Range, Range] | str:
        """x and y ranges from which a stroke by `way_m` keeps all limits; or the violated one."""
        ranges = []
        for axis, (limits, way) in enumerate(zip((self.x_m, self.y_m), way_m, strict=True)):
            low = limits[0] + LIMIT_MARGIN_M - min(0.0, way)
            high = limits[1] - LIMIT_MARGIN_M - max(0.0, way)
            if low > high:
                return "limits"
            if self.picture_m is not None:
                low = max(low, self.picture_m[axis][0] - swept.low_m[axis])
                high = min(high, self.picture_m[axis][1] - swept.high_m[axis])
                if low > high:
                    return "picture"
            ranges.append((low, high))
        if self.workpiece_m is not None:
            nearest = self.workpiece_m + CLEARANCE_M
            # Brought to the start and back: the gripper is between home, start and end, at rest.
            low = max(ranges[0][0], nearest - min(swept.cable_low_m, swept.rest_low_m))
            if low > ranges[0][1] or self.home[0] + swept.rest_low_m < nearest:
                return "workpiece"
            ranges[0] = (low, ranges[0][1])
        return ranges[0], ranges[1]

    def nearest_start(self, swept: Swept, way_m: tuple[float, float]) -> tuple[float, float] | str:
        """The place nearest to home from which a stroke keeps all limits; or why there is none."""
        ranges = self.start_range(swept, way_m)
        if isinstance(ranges, str):
            return ranges
        x, y = (float(np.clip(h, *r)) for h, r in zip(self.home[:2], ranges, strict=True))
        return x, y


def pictured(view: PlaneView, width_px: int, height_px: int) -> tuple[Range, Range]:
    """x and y ranges of an upright rectangle within the picture without its border, m."""
    right, bottom = width_px - 1 - EDGE_PX, height_px - 1 - EDGE_PX
    corners = [[EDGE_PX, EDGE_PX], [right, EDGE_PX], [right, bottom], [EDGE_PX, bottom]]
    x, y = view.to_plane(np.array(corners)).T
    return (
        (float(max(x[0], x[3])), float(min(x[1], x[2]))),
        (float(max(y[2], y[3])), float(min(y[0], y[1]))),
    )


@dataclass(frozen=True)
class Swept:
    """Region that cable and jaw sweep in a stroke, relative to the gripper's start, m.

    low_m, high_m  (2,) corners of the region that the camera must see: cable and jaw
    cable_low_m    least x of the cable on the way
    rest_low_m     least x of the cable at rest, at any angle between home's and the stroke's, with
                   the gripper at the leftmost place of the stroke
    """

    low_m: FloatArray
    high_m: FloatArray
    cable_low_m: float
    rest_low_m: float

    @staticmethod
    def of(
        cable_m: FloatArray, spread_m: FloatArray, hand_m: FloatArray, angle_rad: float, rest: float
    ) -> Swept:
        """Region swept by points along the cable.

        cable_m   (models, times, points, 2) relative to the gripper's start
        spread_m  same shape: uncertainty of the points
        hand_m    (times, 2) relative to its start
        rest      least x of the cable at rest, relative to the gripper
        """
        marks = jaw_points_m(angle_rad)[None] + hand_m[:, None]
        low, high = (cable_m - spread_m).min((0, 1, 2)), (cable_m + spread_m).max((0, 1, 2))
        return Swept(
            np.minimum(low, marks.min((0, 1))),
            np.maximum(high, marks.max((0, 1))),
            float(low[0]),
            rest + min(0.0, float(hand_m[:, 0].min())),
        )


def jaw_points_m(angle_rad: float) -> FloatArray:
    """(points, 2) corners of the jaw's marks relative to the gripping point, m."""
    marks = JawMarks()
    corners = marks.radius_m * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    points = (np.array(marks.centres_m)[:, None] + corners).reshape(-1, 2)
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))
