"""Pose of the jaw: light discs on its plate, detected and fitted as one rigid body."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.cable.arrays import FloatArray
from cell.vision.discs import BodyPose, ImageView, Marks, body_values, disc_memory

Image = NDArray[np.uint8]

#: Largest displacement of a mark between frames, m; beyond it the full picture is searched.
NEXT_FRAME_M = 0.006
_ANY_TURN_M = 0.015  # the same where the angle is not known


@dataclass(frozen=True)
class JawMarks:
    """Light discs on a dark plate, in the jaw's frame.

    The frame: origin at the gripping point, the cable leaves towards −x, y up when level.
    The distances between the discs must all differ, so that each disc can be identified.
    """

    centres_m: tuple[tuple[float, float], ...] = (
        (0.006, 0.009),
        (0.006, -0.009),
        (0.032, 0.009),
        (0.025, -0.003),
    )
    radius_m: float = 0.0025

    #: Distances closer than this are not distinguished; a mark further off is no inlier.
    tolerance_m: float = field(default=0.0005, kw_only=True)

    def __post_init__(self) -> None:
        if len(self.centres_m) < 3:
            raise ValueError(f"{len(self.centres_m)} jaw marks: needs at least 3")
        if not self.radius_m > 0.0:
            raise ValueError(f"jaw marks: radius_m = {self.radius_m}: must be > 0")
        c = np.asarray(self.centres_m)
        rows, columns = np.triu_indices(len(c), 1)
        distances = np.sort(np.linalg.norm(c[rows] - c[columns], axis=1))
        if np.any(np.diff(distances) < 2.0 * self.tolerance_m):
            raise ValueError(
                f"jaw marks: distances {np.round(1e3 * distances, 2).tolist()} mm must differ by"
                f" at least {2e3 * self.tolerance_m:.1f} mm each; move a mark"
            )


@dataclass(frozen=True)
class JawPose:
    """Gripping point (2,) in the plane, clamp angle, marks used and their rms misfit."""

    grip_m: FloatArray
    angle_rad: float
    marks: int
    rms_m: float


def find_jaw(
    image: Image,
    view: PlaneView,
    marks: JawMarks,
    previous_m: FloatArray | None = None,
    previous_rad: float | None = None,
) -> JawPose | None:
    """Pose of the jaw, or None.

    image     (H, W) uint8
    previous_m  (2,) gripping point in an earlier frame, m, around which the search starts
    previous_rad  clamp angle in that frame, if little moves between the two: a closer search
    """
    image = np.require(image, requirements=["C", "W"])
    place = (np.nan, np.nan) if previous_m is None else (float(previous_m[0]), float(previous_m[1]))
    turn, reach_m = (
        (np.nan, _ANY_TURN_M) if previous_rad is None else (float(previous_rad), NEXT_FRAME_M)
    )
    memory = disc_memory(image.shape, len(marks.centres_m))
    values = body_values(
        image, compiled_view(view), disc_marks(marks), memory, (*place, turn), reach_m
    )
    pose = BodyPose(*values)
    if not pose.marks:
        return None
    return JawPose(np.array([pose.x_m, pose.y_m]), pose.angle_rad, pose.marks, pose.rms_m)


@lru_cache(maxsize=8)
def disc_marks(marks: JawMarks) -> Marks:
    """Marks as the compiled functions take them."""
    centres = np.array(marks.centres_m, dtype=np.float64)
    return Marks(centres, float(marks.radius_m), float(marks.tolerance_m))


def compiled_view(view: PlaneView) -> ImageView:
    """A view as the compiled functions take it."""
    maps = np.stack([np.asarray(view.homography, dtype=np.float64), view.inverse])
    if view.lens is None:
        return ImageView(maps, np.zeros(9), False)
    return ImageView(maps, view.lens.numbers, True)


def pixels_per_metre(view: PlaneView, pixel: FloatArray) -> float:
    """Local scale of a view at a pixel (2,)."""
    square = pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    p = view.to_plane(square)
    a, b = p[1] - p[0], p[2] - p[0]
    return float(1.0 / np.sqrt(abs(a[0] * b[1] - a[1] * b[0])))
