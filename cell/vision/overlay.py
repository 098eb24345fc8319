"""A frame with what was seen in it drawn over it, for the records."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.vision.sighting import Sighting

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

_SEEN = (60, 220, 60)  # BGR
_PREDICTED = (60, 140, 255)
_JAW = (255, 180, 40)
_UNSEEN = (60, 60, 255)
_SHIFT = 4  # cv2 draws on sixteenths of a pixel


def overlay(
    image: Image, sighting: Sighting, view: PlaneView, predicted: FloatArray | None = None
) -> Image:
    """(H, W, 3) BGR picture: nodes green, predicted nodes orange, jaw axis blue, words on top.

    predicted  (nodes, 2) nodes expected at that time, m; nan or None = nothing drawn
    """
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    if predicted is not None and np.all(np.isfinite(predicted)):
        _draw_nodes(picture, view.to_pixels(predicted), _PREDICTED)
    if np.all(np.isfinite(sighting.grip_m)):
        c, s = np.cos(sighting.clamp_angle_rad), np.sin(sighting.clamp_angle_rad)
        axis = sighting.grip_m + np.array([[0.0, 0.0], [0.02 * c, 0.02 * s]])
        _draw_line(picture, view.to_pixels(axis), _JAW)
    if sighting.unseen is None:
        _draw_nodes(picture, view.to_pixels(sighting.nodes_m), _SEEN)
        words = f"t {sighting.t_s:.3f} s  quality {sighting.quality:.2f}"
        _write(picture, f"{words}  length {1e3 * sighting.length_m:.2f} mm", _SEEN)
    else:
        _write(picture, f"t {sighting.t_s:.3f} s  unseen: {sighting.unseen.value}", _UNSEEN)
    return picture


def _draw_nodes(picture: Image, pixels: FloatArray, colour: tuple[int, int, int]) -> None:
    _draw_line(picture, pixels, colour)
    for u, v in _sixteenths(pixels).tolist():
        cv2.circle(picture, (u, v), 5 << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)


def _draw_line(picture: Image, pixels: FloatArray, colour: tuple[int, int, int]) -> None:
    cv2.polylines(picture, [_sixteenths(pixels)], False, colour, 1, cv2.LINE_AA, _SHIFT)


def _sixteenths(pixels: FloatArray) -> NDArray[np.int32]:
    """Fixed-point pixels for cv2; far outside the picture is as good as outside."""
    return np.rint(np.clip(pixels, -1e4, 1e4) * (1 << _SHIFT)).astype(np.int32)


def _write(picture: Image, words: str, colour: tuple[int, int, int]) -> None:
    cv2.putText(picture, words, (16, 32), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 4, cv2.LINE_AA)
    cv2.putText(picture, words, (16, 32), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)
