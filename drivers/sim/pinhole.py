"""A camera that may stand anywhere, with a lens that distorts: for pictures with known truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from drivers.interfaces import FloatArray


@dataclass(frozen=True, eq=False)
class Pinhole:
    """Pinhole camera C with lens distortion, before the cell's plane P.

    focal_px     focal length
    centre_px    column and row of the optical axis; centre of the first pixel = 0, 0
    distortion   k1, k2, p1, p2, k3 of OpenCV's model
    X_CP         (4, 4) plane in camera, m; the camera's z axis looks forward, its y axis down
    """

    focal_px: float
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    X_CP: FloatArray

    @classmethod
    def standing(
        cls,
        *,
        metres_per_pixel: float,
        origin_px: tuple[float, float],
        size_px: tuple[int, int],
        focal_px: float,
        tilt_rad: float = 0.0,
        pan_rad: float = 0.0,
        roll_rad: float = 0.0,
        distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> Pinhole:
        """Camera with its optical axis in the middle of the picture, by its view of the plane.

        metres_per_pixel  across the line of sight, at the plane's point in the picture's middle
        origin_px         image of the plane's origin in a camera square to the plane
        size_px           width and height
        tilt_rad          turn about the plane's x axis: positive = looks down on it
        pan_rad           turn about the plane's y axis
        roll_rad          turn about the line of sight, clockwise in the picture
        """
        centre = (0.5 * (size_px[0] - 1), 0.5 * (size_px[1] - 1))
        middle_m = (
            (centre[0] - origin_px[0]) * metres_per_pixel,
            (origin_px[1] - centre[1]) * metres_per_pixel,
        )
        square = np.diag([1.0, -1.0, -1.0])  # the plane's y is up, a picture's rows go down
        turn = (
            cv2.Rodrigues(np.array([0.0, 0.0, roll_rad]))[0]
            @ square
            @ cv2.Rodrigues(np.array([tilt_rad, 0.0, 0.0]))[0]
            @ cv2.Rodrigues(np.array([0.0, pan_rad, 0.0]))[0]
        )
        X = np.eye(4)
        X[:3, :3] = turn
        X[:3, 3] = [0.0, 0.0, focal_px * metres_per_pixel] - turn @ [*middle_m, 0.0]
        return cls(focal_px, centre, distortion, X)

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) camera matrix."""
        u, v = self.centre_px
        return np.array([[self.focal_px, 0.0, u], [0.0, self.focal_px, v], [0.0, 0.0, 1.0]])

    def to_pixels(self, points_m: FloatArray) -> FloatArray:
        """(…, 2) or (…, 3) points in the plane's frame → (…, 2) column, row."""
        points = np.asarray(points_m, dtype=np.float64)
        flat = np.zeros((points.size // points.shape[-1], 3))
        flat[:, : points.shape[-1]] = points.reshape(len(flat), -1)
        in_camera = flat @ self.X_CP[:3, :3].T + self.X_CP[:3, 3]
        still = np.zeros(3)
        pixels, _ = cv2.projectPoints(
            in_camera, still, still, self.matrix, np.array(self.distortion)
        )
        return np.asarray(pixels, dtype=np.float64).reshape(*points.shape[:-1], 2)


#: How a camera sees the plane: (3, 3) pixel → plane, m, of one without distortion; or in full.
Sight = FloatArray | Pinhole


def to_pixels(sight: Sight, points_m: FloatArray) -> FloatArray:
    """(…, 2) points in the plane, or with a `Pinhole` (…, 3) points about it → (…, 2) pixels."""
    if isinstance(sight, Pinhole):
        return sight.to_pixels(points_m)
    flat = np.asarray(points_m, dtype=np.float64).reshape(-1, 1, 2)
    pixels = cv2.perspectiveTransform(flat, np.linalg.inv(sight))
    return np.asarray(pixels, dtype=np.float64).reshape(np.shape(points_m))


def metres_per_pixel(sight: Sight) -> float:
    """Scale at the middle of a `Pinhole`'s picture, or at the plane's origin."""
    if isinstance(sight, Pinhole):
        return float(np.linalg.norm(sight.X_CP[:3, 3]) / sight.focal_px)
    return float(np.hypot(sight[0, 0], sight[1, 0]) / abs(sight[2, 2]))
