"""Place of a pixel in the cell's plane: correction of the lens' distortion, then a homography."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.lens import Lens
from drivers.interfaces import FloatArray


@dataclass(frozen=True)
class PlaneView:
    """Mapping between pixels (column, row; centre of the first pixel = 0, 0) and the plane.

    Points are mapped, not pictures: detections are corrected, not the picture.

    homography   (3, 3) H_PC: homogeneous ideal pixel → homogeneous plane, m
    lens         its distortion is corrected first; None = no distortion, every pixel is ideal
    """

    homography: FloatArray
    lens: Lens | None = None

    @classmethod
    def from_scale(
        cls, metres_per_pixel: float, origin_column_px: float, origin_row_px: float
    ) -> PlaneView:
        """Camera square to the plane: y up, origin of the plane at the given pixel."""
        s = metres_per_pixel
        return cls(
            np.array(
                [[s, 0.0, -s * origin_column_px], [0.0, -s, s * origin_row_px], [0.0, 0.0, 1.0]]
            )
        )

    @classmethod
    def from_pose(cls, lens: Lens, X_CP: FloatArray) -> PlaneView:
        """View of the plane's xy from its (4, 4) pose P in the camera C, which looks along z."""
        to_ideal = lens.matrix @ X_CP[:3][:, [0, 1, 3]]
        return cls(np.asarray(np.linalg.inv(to_ideal), dtype=np.float64), lens)

    @cached_property
    def inverse(self) -> FloatArray:
        """(3, 3) H_CP: homogeneous plane, m → homogeneous pixel."""
        return np.asarray(np.linalg.inv(self.homography), dtype=np.float64)

    def to_plane(self, pixels: FloatArray) -> FloatArray:
        """(…, 2) column, row → (…, 2) x, y in m."""
        return map_homography(
            self.homography, pixels if self.lens is None else self.lens.ideal(pixels)
        )

    def to_pixels(self, points: FloatArray) -> FloatArray:
        """(…, 2) x, y in m → (…, 2) column, row."""
        ideal = map_homography(self.inverse, points)
        return ideal if self.lens is None else self.lens.distorted(ideal)


def fit_homography(pixels: FloatArray, points: FloatArray) -> FloatArray:
    """(3, 3) that maps (N, 2) pixels to (N, 2) points, by singular values.

    Both sides are moved to mean 0 and mean distance √2 first.
    raises  ValueError: too nearly on one line
    """
    T_P, T_W = _normalising(pixels), _normalising(points)
    p, w = map_homography(T_P, pixels), map_homography(T_W, points)
    zero, one = np.zeros(len(p)), np.ones(len(p))
    u, v, x, y = p[:, 0], p[:, 1], w[:, 0], w[:, 1]
    rows = np.concatenate(
        [
            np.stack([u, v, one, zero, zero, zero, -x * u, -x * v, -x], axis=1),
            np.stack([zero, zero, zero, u, v, one, -y * u, -y * v, -y], axis=1),
        ]
    )
    _, singular, right = np.linalg.svd(rows)
    if singular[7] < 1e-6 * singular[0]:
        raise ValueError("the points lie too nearly on one line; spread them over the picture")
    h = np.linalg.inv(T_W) @ right[-1].reshape(3, 3) @ T_P
    return np.asarray(h / h[2, 2], dtype=np.float64)


def _normalising(points: FloatArray) -> FloatArray:
    mean = points.mean(axis=0)
    spread = float(np.mean(np.linalg.norm(points - mean, axis=1)))
    if spread == 0.0:
        raise ValueError("all points are the same")
    k = np.sqrt(2.0) / spread
    return np.array([[k, 0.0, -k * mean[0]], [0.0, k, -k * mean[1]], [0.0, 0.0, 1.0]])


def map_homography(h: FloatArray, points: FloatArray) -> FloatArray:
    """(…, 2) points mapped by a (3, 3) homography."""
    p = np.asarray(points, dtype=np.float64)
    w = p[..., 0] * h[2, 0] + p[..., 1] * h[2, 1] + h[2, 2]
    x = p[..., 0] * h[0, 0] + p[..., 1] * h[0, 1] + h[0, 2]
    y = p[..., 0] * h[1, 0] + p[..., 1] * h[1, 1] + h[1, 2]
    return np.stack([x / w, y / w], axis=-1)
