"""Distortion of a lens: mapping between ideal pixels of a pinhole camera and actual pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numba import njit

from drivers.interfaces import FloatArray

#: Order of the numbers of a lens.
LENS_NUMBERS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class Lens:
    """Focal lengths, optical axis (centre of the first pixel = 0, 0) and distortion of a camera.

    An *ideal* pixel is that of a pinhole camera with these focal lengths and axis, but without
    distortion.

    source  Brown 1966; the numbers are those of OpenCV's five-parameter model
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @classmethod
    def of(cls, numbers: FloatArray) -> Lens:
        """Lens from its (9,) numbers in the order of `LENS_NUMBERS`."""
        return cls(*(float(v) for v in numbers))

    @cached_property
    def numbers(self) -> FloatArray:
        """(9,) in the order of `LENS_NUMBERS`."""
        return np.array([getattr(self, name) for name in LENS_NUMBERS])

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) camera matrix: direction → ideal pixel."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    def distorted(self, ideal_px: FloatArray) -> FloatArray:
        """(…, 2) ideal pixels → (…, 2) pixels of the picture."""
        return distort(self.numbers, np.asarray(ideal_px, dtype=np.float64))

    def ideal(self, pixels: FloatArray) -> FloatArray:
        """(…, 2) pixels of the picture → (…, 2) ideal pixels; nan where there is none."""
        pixels = np.asarray(pixels, dtype=np.float64)
        flat = np.ascontiguousarray(pixels.reshape(-1, 2))
        return np.asarray(_all_undistorted(self.numbers, flat)).reshape(pixels.shape)


def distort(numbers: FloatArray, ideal_px: FloatArray) -> FloatArray:
    """(…, 2) ideal pixels → (…, 2) pixels, for the (9,) numbers of a lens."""
    return np.stack(distorted(numbers, ideal_px[..., 0], ideal_px[..., 1]), axis=-1)


def distorted(numbers: FloatArray, column: Any, row: Any) -> tuple[Any, Any]:
    """Column and row in the picture of an ideal pixel, or of arrays of them."""
    fx, fy, cx, cy = numbers[0], numbers[1], numbers[2], numbers[3]
    k1, k2, p1, p2, k3 = numbers[4], numbers[5], numbers[6], numbers[7], numbers[8]
    x, y = (column - cx) / fx, (row - cy) / fy
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return fx * u + cx, fy * v + cy


def undistorted(numbers, column, row):  # type: ignore[no-untyped-def]
    """Ideal column and row by Newton's method: 1e-9 px after five steps, or nan."""
    fx, fy, cx, cy = numbers[0], numbers[1], numbers[2], numbers[3]
    k1, k2, p1, p2, k3 = numbers[4], numbers[5], numbers[6], numbers[7], numbers[8]
    u, v = (column - cx) / fx, (row - cy) / fy
    x, y = u, v
    error = np.inf
    for _ in range(20):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        e = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - u
        f = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - v
        error = abs(e) + abs(f)
        if error < 1e-13:
            break
        a = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        b = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        determinant = a * d - b * b
        if determinant <= 0.0:
            error = np.inf
            break
        x -= (d * e - b * f) / determinant
        y -= (a * f - b * e) / determinant
    if error < 1e-10:
        return fx * x + cx, fy * y + cy
    return np.nan, np.nan


_undistorted = njit(undistorted)


@njit(cache=True)
def _all_undistorted(numbers, pixels):  # type: ignore[no-untyped-def]
    """(N, 2) ideal pixels, or nan."""
    out = np.empty_like(pixels)
    for i in range(len(pixels)):
        out[i, 0], out[i, 1] = _undistorted(numbers, pixels[i, 0], pixels[i, 1])
    return out


def project(numbers: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of points before a camera, and their derivatives.

    numbers  (9,) of a lens, see `LENS_NUMBERS`
    points   (N, 3) in the camera's frame, m
    returns  (N, 2) pixels, (N, 2, 3) derivatives by the points, (N, 2, 9) by the numbers
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    z = points[:, 2]
    x, y = points[:, 0] / z, points[:, 1] / z
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    a = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    b = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    d = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    by_point = np.empty((len(points), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 1] = fx * a / z, fx * b / z
    by_point[:, 1, 0], by_point[:, 1, 1] = fy * b / z, fy * d / z
    by_point[:, :, 2] = -(by_point[:, :, 0] * x[:, None] + by_point[:, :, 1] * y[:, None])
    by_lens = np.zeros((len(points), 2, 9))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = u, v
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    for column, power in ((4, r2), (5, r2 * r2), (8, r2 * r2 * r2)):
        by_lens[:, 0, column], by_lens[:, 1, column] = fx * x * power, fy * y * power
    by_lens[:, 0, 6], by_lens[:, 1, 6] = fx * 2.0 * x * y, fy * (r2 + 2.0 * y * y)
    by_lens[:, 0, 7], by_lens[:, 1, 7] = fx * (r2 + 2.0 * x * x), fy * 2.0 * x * y
    return np.stack([fx * u + cx, fy * v + cy], axis=1), by_point, by_lens


def rotation(vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(3, 3) rotation by a (3,) rotation vector, and its (3, 3, 3) derivatives by it, last axis."""
    matrix, by_vector = cv2.Rodrigues(np.asarray(vector, dtype=np.float64))
    return (
        np.asarray(matrix, dtype=np.float64),
        np.moveaxis(np.asarray(by_vector, dtype=np.float64).reshape(3, 3, 3), 0, -1),
    )


def pose(numbers: FloatArray) -> FloatArray:
    """(4, 4) pose from (6,) rotation vector and translation."""
    X = np.eye(4)
    X[:3, :3] = cv2.Rodrigues(np.asarray(numbers[:3], dtype=np.float64))[0]
    X[:3, 3] = numbers[3:]
    return X
