"""Detects the light discs on the jaw's plate in a picture, without a prior of its pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.plane import fit_homography, map_homography
from drivers.interfaces import FloatArray

Image = NDArray[np.uint8]

_RADII_PX = (3.0, 60.0)
_MOST_CANDIDATES = 14
_LEAST_CONTRAST = 25.0
#: Least apparent width of a plate, relative to its height, and largest distance of the marks beyond
#: the third from their affine prediction, in radii: perspective at 40°.
_NARROWEST, _MOST_OFF = 0.7, 0.4


@dataclass(frozen=True, eq=False)
class DetectedPlate:
    """The marks of a plate in a picture: (M, 2) pixels of their centres, and their smear.

    smear_px  distance in the picture that they moved during the exposure
    """

    pixels: FloatArray
    smear_px: float


def find_plate(image: Image, marks_m: FloatArray, radius_m: float) -> DetectedPlate | None:
    """The marks of the plate, or None.

    image     (H, W) grey levels
    marks_m   (M ≥ 4, 2) centres of light discs on a dark plate, x right, y up; only the identity
              among affine maps permutes them
    radius_m  of the discs
    """
    centres, areas, spreads = _discs(image)
    best: list[int] | None = None
    least_off = _MOST_OFF
    known = np.column_stack([marks_m, np.ones(len(marks_m))])
    solve = np.linalg.inv(known[:3])
    for first in permutations(range(len(centres)), 3):
        triple = list(first)
        affine = (solve @ centres[triple]).T  # (2, 3): mark → pixel
        scale = -float(np.linalg.det(affine[:, :2]))  # rows go down: a plate not mirrored turns
        if scale <= 0.0:
            continue
        lengths = np.linalg.svd(affine[:, :2], compute_uv=False)
        area = np.pi * radius_m**2 * scale
        if lengths[1] < _NARROWEST * lengths[0] or np.any(abs(areas[triple] / area - 1.0) > 0.25):
            continue
        off = np.linalg.norm((known[3:] @ affine.T)[:, None] - centres[None], axis=2)
        chosen = [*triple, *off.argmin(axis=1).tolist()]
        worst = float(off.min(axis=1).max() / np.sqrt(area / np.pi))
        if worst < least_off and len(set(chosen)) == len(chosen):
            best, least_off = chosen, worst
    if best is None:
        return None
    smear_px = _smear_px(centres[best], areas[best], spreads[best], marks_m)
    return DetectedPlate(centres[best], smear_px)


def _smear_px(
    centres: FloatArray, areas: FloatArray, spreads: FloatArray, marks_m: FloatArray
) -> float:
    """Length of the streak that lengthens all discs in one direction of the picture.

    The ellipse of a disc at rest is predicted from the places of all marks; the lens' blur widens
    it equally in all directions.
    """
    to_pixel = fit_homography(marks_m, centres)
    step_m, around = 1e-4, np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    more = np.zeros((2, 2))
    for mark, area, spread in zip(marks_m, areas, spreads, strict=True):
        ends = map_homography(to_pixel, mark + step_m * around)
        slope = np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=1) / (2.0 * step_m)
        even = slope @ slope.T * area / (4.0 * np.pi * abs(np.linalg.det(slope)))
        more += (spread - even) / len(marks_m)
    low, high = np.linalg.eigvalsh(more)
    return float(np.sqrt(12.0 * (high - low)))


def _discs(image: Image) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Round light patches within something darker: (N, 2) centres, (N,) areas, (N, 2, 2) spreads.

    spreads  second moments of the light about the centre, px²
    """
    smooth = cv2.GaussianBlur(image, (3, 3), 0.8)
    light = cv2.adaptiveThreshold(
        smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, 101, -12
    )
    count, labels, stats, _ = cv2.connectedComponentsWithStats(light, connectivity=4)
    discs: list[_Disc] = []
    for k in range(1, count):
        left, top, width, height, area = (int(v) for v in stats[k])
        radius = np.sqrt(area / np.pi)
        if not _RADII_PX[0] <= radius <= _RADII_PX[1] or max(width, height) > 3.2 * min(
            width, height
        ):
            continue
        margin = 4 + round(0.5 * radius)
        if left < margin or top < margin:
            continue
        rows = slice(top - margin, top + height + margin)
        columns = slice(left - margin, left + width + margin)
        part, own = image[rows, columns], labels[rows, columns] == k
        if part.shape != (height + 2 * margin, width + 2 * margin):
            continue
        disc = _centroid(part.astype(np.float64), own, (labels[rows, columns] > 0) & ~own)
        if disc is not None:
            corner = np.array([columns.start, rows.start])
            discs.append(replace(disc, centre=disc.centre + corner))
    discs = sorted(discs, key=lambda disc: disc.off)[:_MOST_CANDIDATES]
    return (
        np.array([disc.centre for disc in discs]).reshape(-1, 2),
        np.array([disc.area for disc in discs]),
        np.array([disc.spread for disc in discs]).reshape(-1, 2, 2),
    )


@dataclass(frozen=True, eq=False)
class _Disc:
    """(2,) column and row, area, (2, 2) second moments, and deviation from an ellipse."""

    centre: FloatArray
    area: float
    spread: FloatArray
    off: float


def _centroid(part: FloatArray, own: NDArray[np.bool_], others: NDArray[np.bool_]) -> _Disc | None:
    """A disc within a part of the picture; None if it is not one."""
    cross = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    near = cv2.dilate(own.astype(np.uint8), cross) > 0
    ring = (cv2.dilate(near.astype(np.uint8), cross) > 0) & ~near & ~others
    core = cv2.erode(own.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if ring.sum() < 12 or core.sum() < 6:
        return None
    around, inside = float(np.median(part[ring])), float(np.median(part[core]))
    if inside - around < _LEAST_CONTRAST:
        return None
    share = np.where(near, (part - around) / (inside - around), 0.0)
    total = float(share.sum())
    rows, columns = np.mgrid[: part.shape[0], : part.shape[1]]
    u, v = float((share * columns).sum()) / total, float((share * rows).sum()) / total
    du, dv = columns - u, rows - v
    spread = np.array([[(share * du * du).sum(), (share * du * dv).sum()],
                       [(share * du * dv).sum(), (share * dv * dv).sum()]]) / total  # fmt: skip
    # of an even ellipse: area = 4π √det of its second moments
    even = 4.0 * np.pi * float(np.sqrt(max(np.linalg.det(spread), 0.0)))
    off = abs(even / total - 1.0)
    return _Disc(np.array([u, v]), total, spread, off) if off < 0.2 and total > 0.0 else None
