"""What a camera sees of points, with all derivatives: the common core of the joint fits."""

from __future__ import annotations

import cv2
import numpy as np

from drivers.interfaces import FloatArray


def project(numbers: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of points before a camera, and how they change.

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
