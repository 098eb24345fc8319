"""Where a pixel lies in the cell's plane: a homography and its inverse."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PlaneView:
    """Mapping between pixels (column, row; centre of the first pixel = 0, 0) and the plane.

    homography   (3, 3) H_PC: homogeneous pixel → homogeneous plane, m
    """

    homography: FloatArray

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

    @cached_property
    def _inverse(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.homography), dtype=np.float64)

    def to_plane(self, pixels: FloatArray) -> FloatArray:
        """(…, 2) column, row → (…, 2) x, y in m."""
        return _apply(self.homography, pixels)

    def to_pixels(self, points: FloatArray) -> FloatArray:
        """(…, 2) x, y in m → (…, 2) column, row."""
        return _apply(self._inverse, points)


def _apply(h: FloatArray, points: FloatArray) -> FloatArray:
    p = np.asarray(points, dtype=np.float64)
    w = p[..., 0] * h[2, 0] + p[..., 1] * h[2, 1] + h[2, 2]
    x = p[..., 0] * h[0, 0] + p[..., 1] * h[0, 1] + h[0, 2]
    y = p[..., 0] * h[1, 0] + p[..., 1] * h[1, 1] + h[1, 2]
    return np.stack([x / w, y / w], axis=-1)
