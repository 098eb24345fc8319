"""Annotated images for the record: detected and predicted nodes, legend, scale bar, inset."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.plane import PlaneView
from cell.cable.arrays import FloatArray
from cell.vision.sighting import Sighting

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

SEEN: Colour = (60, 220, 60)  # BGR
PREDICTED: Colour = (60, 140, 255)
DESTINATION: Colour = (60, 60, 255)
JAW: Colour = (255, 180, 40)
UNSEEN: Colour = (60, 60, 255)
WHITE: Colour = (255, 255, 255)

_SHIFT = 4  # cv2 draws on sixteenths of a pixel
#: Lengths of scale bars, m; the one nearest to a fifth of the picture's width is drawn.
_BARS_M = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
#: Magnifications of differences; the largest that fits its inset is used.
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
#: Width of a picture at which letters have their full size, px.
_FULL_PX = 1280.0


def sixteenths(pixels: FloatArray) -> NDArray[np.int32]:
    """Fixed-point pixels for cv2, clipped far outside the image."""
    return np.rint(np.clip(pixels, -1e4, 1e4) * (1 << _SHIFT)).astype(np.int32)


def line(
    picture: Image,
    pixels: FloatArray,
    colour: Colour,
    width_px: int = 1,
    *,
    closed: bool = False,
    dashed: bool = False,
) -> None:
    """Draw a line through (n, 2) pixels; points that are nan are skipped."""
    points = sixteenths(pixels[np.isfinite(pixels).all(axis=1)])
    if dashed:
        for start in range(0, len(points) - 1, 4):
            piece = points[start : start + 3]
            cv2.polylines(picture, [piece], False, colour, width_px, cv2.LINE_AA, _SHIFT)
    elif len(points):
        cv2.polylines(picture, [points], closed, colour, width_px, cv2.LINE_AA, _SHIFT)


def write(picture: Image, words: str, at_px: tuple[int, int], colour: Colour) -> None:
    """Write words, dark-edged, so that they can be read on any ground; cv2's letters are ASCII."""
    size = 0.7 * _letters(picture)
    for shade, width in (((0, 0, 0), 4), (colour, 1 if size < 0.5 else 2)):
        cv2.putText(
            picture, words, at_px, cv2.FONT_HERSHEY_SIMPLEX, size, shade, width, cv2.LINE_AA
        )


def title(picture: Image, lines: Sequence[tuple[str, Colour]]) -> None:
    """Write lines of words from the top left corner down."""
    step = round(30 * _letters(picture))
    for i, (words, colour) in enumerate(lines):
        write(picture, words, (round(16 * _letters(picture)), step * (i + 1)), colour)


def legend(picture: Image, entries: Sequence[tuple[str, Colour]]) -> None:
    """Draw the legend of colours in the bottom left corner."""
    scale, height = _letters(picture), picture.shape[0]
    step, left = round(28 * scale), round(16 * scale)
    for i, (words, colour) in enumerate(entries):
        y = height - round(20 * scale) - step * (len(entries) - 1 - i)
        middle = y - round(7 * scale)
        ends = np.array([[left, middle], [left + 36 * scale, middle]], np.float64)
        line(picture, ends, (0, 0, 0), 6)
        line(picture, ends, colour, 3)
        write(picture, words, (left + round(46 * scale), y), colour)


def scale_bar(picture: Image, metres_per_pixel: float) -> None:
    """Draw a bar of a round length in the bottom right corner, labelled in mm."""
    height, width = picture.shape[:2]
    bar_m = min(_BARS_M, key=lambda b: abs(b / metres_per_pixel - 0.2 * width))
    bar_px, scale = bar_m / metres_per_pixel, _letters(picture)
    right, y = width - 24 * scale, height - 24 * scale
    ends = np.array([[right - bar_px, y], [right, y]])
    ticks = [ends[i] + np.array([[0.0, -6.0], [0.0, 6.0]]) * scale for i in (0, 1)]
    for colour, wide in (((0, 0, 0), 6), (WHITE, 2)):
        for piece in (ends, *ticks):
            line(picture, piece, colour, wide)
    at = (round(right - bar_px), round(y - 14 * scale))
    write(picture, f"{bar_m * 1e3:g} mm", at, WHITE)


def difference_inset(
    picture: Image, detected_m: FloatArray, predicted_m: FloatArray, metres_per_pixel: float
) -> float:
    """Draw the magnified difference of detected and predicted nodes in the top right corner.

    Predicted points are in the centre, detected ones at their difference, enlarged by the factor
    in the label; a circle shows the largest difference.

    detected_m, predicted_m  (n, 2) corresponding points; nan = not known
    returns  the largest difference, m; nan = none is known
    """
    differences_m = (detected_m - predicted_m)[np.isfinite(detected_m - predicted_m).all(axis=1)]
    if not len(differences_m):
        return float("nan")
    largest_m = float(np.hypot(*differences_m.T).max())
    scale = _letters(picture)
    half = round(90 * scale)
    fits = [m for m in _MAGNIFICATIONS if m * largest_m / metres_per_pixel < 0.8 * half]
    times = fits[-1] if fits else 1
    left, top = picture.shape[1] - 2 * half - round(16 * scale), round(16 * scale)
    inset = picture[top : top + 2 * half, left : left + 2 * half]
    inset[:] = inset // 3
    edge = np.array([[-half, -half], [half, -half], [half, half], [-half, half]], np.float64)
    centre = np.array([left + half, top + half], np.float64)
    line(picture, centre + edge, WHITE, 1, closed=True)
    for arm in ([8.0, 0.0], [0.0, 8.0]):
        line(picture, centre + np.array([arm, np.negative(arm)]), PREDICTED, 2)
    radius = times * largest_m / metres_per_pixel
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    line(picture, centre + radius * np.column_stack([np.cos(turn), np.sin(turn)]), WHITE, 1)
    pixels = centre + times * differences_m * [1.0, -1.0] / metres_per_pixel
    line(picture, pixels, SEEN, 1)
    for u, v in sixteenths(pixels).tolist():
        cv2.circle(picture, (u, v), 3 << _SHIFT, SEEN, -1, cv2.LINE_AA, _SHIFT)
    words = f"measured - predicted, x{times}: max {largest_m * 1e3:.2f} mm"
    wide = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, 0.7 * scale, 2)[0][0]
    right = picture.shape[1] - round(16 * scale)
    write(picture, words, (right - wide, top + 2 * half + round(24 * scale)), WHITE)
    return largest_m


def _letters(picture: Image) -> float:
    """Size of letters, relative to those in a picture of full width."""
    return float(np.clip(picture.shape[1] / _FULL_PX, 0.45, 2.0))


def overlay(
    image: Image, sighting: Sighting, view: PlaneView, predicted: FloatArray | None = None
) -> Image:
    """(H, W, 3) BGR picture: detected nodes green, predicted ones orange, jaw axis blue, text.

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
        # Last and wider, so that the detected nodes do not hide them.
        _draw_nodes(picture, view.to_pixels(predicted), PREDICTED, 9)
    return picture


def _draw_nodes(picture: Image, pixels: FloatArray, colour: Colour, radius_px: int) -> None:
    line(picture, pixels, colour)
    for u, v in sixteenths(pixels).tolist():
        cv2.circle(picture, (u, v), radius_px << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)
