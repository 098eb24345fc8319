"""Poses as a UR controller writes them, six numbers, and as 4 × 4 matrices X_BT (tool in base)."""

from __future__ import annotations

import cv2
import numpy as np

from drivers.interfaces import FloatArray


def matrix_of(pose: FloatArray) -> FloatArray:
    """(6,) position and rotation vector → (4, 4)."""
    X = np.eye(4)
    X[:3, 3] = pose[:3]
    X[:3, :3] = cv2.Rodrigues(np.asarray(pose[3:6], dtype=np.float64))[0]
    return X


def pose_of(X: FloatArray) -> FloatArray:
    """(4, 4) → (6,) position and rotation vector."""
    return np.concatenate([X[:3, 3], cv2.Rodrigues(X[:3, :3])[0].ravel()])
