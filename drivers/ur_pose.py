"""Poses as a UR controller writes them, six numbers, and as 4 × 4 matrices X_BT (tool in base)."""

from __future__ import annotations

import cv2
import numpy as np

from drivers.interfaces import FloatArray


def matrix_of(pose: FloatArray) -> FloatArray:
    """(6,) position and rotation vector → (4, 4)."""
    X = np.zeros((4, 4))
    X[:3, 3] = pose[:3]
    X[:3, :3] = cv2.Rodrigues(np.asarray(pose[3:6], dtype=np.float64))[0]
    X[3, 3] = 1.0
    return X


def matrices_of(poses: FloatArray) -> FloatArray:
    """(n, 6) positions and rotation vectors → (n, 4, 4), a hundred times as fast as one by one."""
    vectors = poses[:, 3:6]
    angle = np.sqrt(np.sum(vectors * vectors, axis=1))
    axis = vectors / np.where(angle > 0.0, angle, 1.0)[:, None]
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    x, y, z = axis.T
    o = np.zeros_like(x)
    cross = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=1).reshape(-1, 3, 3)
    X = np.zeros((len(poses), 4, 4))
    X[:, :3, :3] = cosine * np.eye(3) + sine * cross
    X[:, :3, :3] += (1.0 - cosine) * axis[:, :, None] * axis[:, None, :]
    X[:, :3, 3] = poses[:, :3]
    X[:, 3, 3] = 1.0
    return X


def pose_of(X: FloatArray) -> FloatArray:
    """(4, 4) → (6,) position and rotation vector."""
    return np.concatenate([X[:3, 3], cv2.Rodrigues(X[:3, :3])[0].ravel()])
