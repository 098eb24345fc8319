"""A frame with what was seen in it drawn over it, for the records."""

from __future__ import annotations

import cv2
import numpy as np

from calib.plane import PlaneView
from cell.cable.arrays import FloatArray
from cell.vision.annotation import (
    JAW,
    PREDICTED,
    SEEN,
    UNSEEN,
    Colour,
    Image,
    line,
    sixteenths,
    title,
)
from cell.vision.sighting import Sighting

_SHIFT = 4  # cv2 draws on sixteenths of a pixel


def overlay(
    image: Image, sighting: Sighting, view: PlaneView, predicted: FloatArray | None = None
) -> Image:
    """(H, W, 3) BGR picture: nodes seen green, predicted nodes orange, jaw axis blue, words on top.

    predicted  (nodes, 2) nodes expected at that time, m; nan or None = nothing drawn
    """
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    if np.all(np.isfinite(sighting.grip_m)):
        c, s = np.cos(sighting.clamp_angle_rad), np.sin(sighting.clamp_angle_rad)
        axis = sighting.grip_m + np.array([[0.0, 0.0], [0.02 * c, 0.02 * s]])
        line(picture, view.to_pixels(axis), JAW)
    if sighting.unseen is None:
        _draw_nodes(picture, view.to_pixels(sighting.nodes_m), SEEN, 5)
        words = f"t {sighting.t_s:.3f} s  quality {sighting.quality:.2f}"
        title(picture, [(f"{words}  length {1e3 * sighting.length_m:.2f} mm", SEEN)])
    else:
        title(picture, [(f"t {sighting.t_s:.3f} s  unseen: {sighting.unseen.value}", UNSEEN)])
    if predicted is not None and np.all(np.isfinite(predicted)):
        # Last and wider, so that what was seen does not hide it.
        _draw_nodes(picture, view.to_pixels(predicted), PREDICTED, 9)
    return picture


def _draw_nodes(picture: Image, pixels: FloatArray, colour: Colour, radius_px: int) -> None:
    line(picture, pixels, colour)
    for u, v in sixteenths(pixels).tolist():
        cv2.circle(picture, (u, v), radius_px << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)
