"""A photograph of a strip clamped at the picture's edge, seen edge-on → centreline and curvature.

The same following and the same curve as for the cell's own cable; what differs is that a strip of
cloth is thick, frayed and uneven, so the picture is coarsened first, and how smooth the curve must
be is found by cross-validation over stretches longer than the unevenness.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.vision.curve import Centreline, choose_penalty, chord_parameters, fit_curve
from cell.vision.ridge import GreyImage, RidgeStart, find_start, follow, new_scratch

Image = NDArray[np.uint8]

_INTERVALS = 16
_STRETCHES = 25  # left out in turn by the cross-validation


class StripNotFoundError(ValueError):
    """No strip leaves the edge of the photograph.  Scenario: wrong edge, wrong polarity, blur."""


@dataclass(frozen=True)
class PhotographOptions:
    """Scale, edge and polarity of a photograph.

    metres_per_pixel  of the photograph
    edge              at which the strip is clamped
    strip_is          lighter or darker than what is behind it
    thickness_m       of the strip as seen, about; the picture is coarsened to 2.5 pixels of it
    clamp_angle_rad   at the clamp from the photograph's horizontal, positive = pointing down;
                      None = unknown.  Near the clamp the curvature hangs on it
    gap_m             how much of the strip may be too dim to see
    """

    metres_per_pixel: float
    edge: Literal["left", "right"] = "left"
    strip_is: Literal["light", "dark"] = "light"
    thickness_m: float = 0.001
    clamp_angle_rad: float | None = 0.0
    gap_m: float = 0.013

    def __post_init__(self) -> None:
        for name in ("metres_per_pixel", "thickness_m", "gap_m"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"photograph.{name} = {getattr(self, name)}: must be > 0")


def centreline(image: Image, options: PhotographOptions) -> Centreline:
    """Centreline of the strip from the clamp to its end.

    image    (H, W) grey levels
    returns  dense samples; origin at the clamp, x from the clamped edge into the photograph, y up
    raises   ValueError: the image is not (H, W) uint8; StripNotFoundError
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"image is {image.shape} {image.dtype}; needs (H, W) uint8")
    if options.edge == "right":
        image = np.ascontiguousarray(image[:, ::-1])
    if options.strip_is == "dark":
        image = 255 - image
    coarsening = max(1, round(options.thickness_m / options.metres_per_pixel / 2.5))
    coarse = _coarse(image, coarsening)
    pixel_m = options.metres_per_pixel * coarsening
    points = _follow_strip(coarse, options.gap_m / pixel_m)
    xy = pixel_m * np.stack([points[:, 0] + 0.5, -(points[:, 1] + 0.5)], axis=1)

    at_edge = np.array([[0.0, xy[0, 1]]])
    u = chord_parameters(np.vstack([at_edge, xy]))[1:]
    start: FloatArray | None = None
    if options.clamp_angle_rad is not None:
        start = np.array([np.cos(options.clamp_angle_rad), -np.sin(options.clamp_angle_rad)])
    penalty = choose_penalty(u, xy, _INTERVALS, _STRETCHES, start)
    curve = fit_curve(u, xy, np.ones(len(u)), _INTERVALS, penalty, start)
    line = curve.centreline(1001)
    return Centreline(
        line.arc_length_m, line.xy_m - line.xy_m[0], line.angle_rad, line.curvature_1_per_m
    )


def _coarse(image: Image, coarsening: int) -> Image:
    """Only what is lighter than Otsu's threshold, averaged over coarser pixels."""
    threshold, _ = cv2.threshold(image, 0, 255, cv2.THRESH_OTSU)
    above = cv2.subtract(image, np.full_like(image, int(threshold)))
    height, width = image.shape
    size = (width // coarsening, height // coarsening)
    above = above[: size[1] * coarsening, : size[0] * coarsening]
    return np.asarray(cv2.resize(above, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _follow_strip(coarse: Image, gap_px: float) -> FloatArray:
    """(N, 2) points along the strip that leaves the left edge of a coarse picture."""
    picture, scratch = GreyImage.of(coarse, 1), new_scratch()
    at_edge = coarse[:, 1:6].mean(axis=1)
    row = float(np.argmax(np.convolve(at_edge, np.ones(3), mode="same")))
    u, v, du, dv, contrast = find_start(picture, (0.0, row), (1.0, 0.0), 3.0, 0.8, scratch)
    if not contrast > 5.0:
        raise StripNotFoundError(
            f"no strip leaves the edge near row {row:.0f} of {len(coarse)} (contrast"
            f" {contrast:.1f} grey levels, needs 5): check edge, strip_is and thickness_m"
        )
    line = np.empty((2 * max(coarse.shape) + 2, 3))  # points are 2 pixels apart
    start = RidgeStart(u + 3.0 * du, v + 3.0 * dv, du, dv, contrast)
    count, _ = follow(picture, start, 0.15, 2.0, float(gap_px), line, scratch)
    if count < 40:
        raise StripNotFoundError(
            f"the strip ends {2 * count} coarse pixels from the edge; needs 80:"
            " check thickness_m and gap_m"
        )
    return line[:count, :2]
