"""Where the jaw is: light discs on its plate, found and fitted as one rigid body."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from calib.plane import PlaneView

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

#: From one frame to the next a mark moves less than this, or is looked for everywhere, m.
_NEXT_FRAME_M = 0.006


@dataclass(frozen=True)
class JawMarks:
    """Light discs on a dark plate, in the jaw's frame.

    The frame: origin at the gripping point, the cable leaves towards −x, y up when level.
    The distances between the discs must all differ, so that each is known by its place.
    """

    centres_m: tuple[tuple[float, float], ...] = (
        (0.006, 0.009),
        (0.006, -0.009),
        (0.032, 0.009),
        (0.025, -0.003),
    )
    radius_m: float = 0.0025

    #: Two distances nearer than this cannot be told apart, and a mark this far off is another's.
    tolerance_m: float = field(default=0.0005, kw_only=True)

    def __post_init__(self) -> None:
        if len(self.centres_m) < 3:
            raise ValueError(f"{len(self.centres_m)} jaw marks: needs at least 3")
        if not self.radius_m > 0.0:
            raise ValueError(f"jaw marks: radius_m = {self.radius_m}: must be > 0")
        c = np.asarray(self.centres_m)
        rows, columns = np.triu_indices(len(c), 1)
        distances = np.sort(np.linalg.norm(c[rows] - c[columns], axis=1))
        if np.any(np.diff(distances) < 2.0 * self.tolerance_m):
            raise ValueError(
                f"jaw marks: distances {np.round(1e3 * distances, 2).tolist()} mm must differ by"
                f" at least {2e3 * self.tolerance_m:.1f} mm each; move a mark"
            )


@dataclass(frozen=True)
class JawPose:
    """Gripping point (2,) in the plane, clamp angle, marks used and their rms misfit."""

    grip_m: FloatArray
    angle_rad: float
    marks: int
    rms_m: float


def find_jaw(
    image: Image,
    view: PlaneView,
    marks: JawMarks,
    near: FloatArray | None = None,
    near_rad: float | None = None,
) -> JawPose | None:
    """Pose of the jaw, or None.

    near      (2,) gripping point in an earlier frame, m: looked for around it first
    near_rad  clamp angle in that frame, if nothing moves far between the two: looked for nearer
    source    Kabsch 1976 (rigid fit)
    """
    if near is not None and np.all(np.isfinite(near)):
        centres = np.asarray(marks.centres_m)
        if near_rad is None:
            places, reach = near[None], 0.015 + float(np.abs(centres).max()) + marks.radius_m
        else:
            c, s = np.cos(near_rad), np.sin(near_rad)
            places = near + centres @ np.array([[c, s], [-s, c]])
            reach = _NEXT_FRAME_M + marks.radius_m
        corners = np.array([[-reach, -reach], [-reach, reach], [reach, -reach], [reach, reach]])
        pixels = view.to_pixels((places[:, None] + corners).reshape(-1, 2))
        height, width = image.shape
        left, top = np.clip(np.floor(pixels.min(0)), 0, [width, height]).astype(int).tolist()
        right, bottom = np.clip(np.ceil(pixels.max(0)), 0, [width, height]).astype(int).tolist()
        if right - left > 8 and bottom - top > 8:
            pose = _find(image[top:bottom, left:right], (left, top), view, marks)
            if pose is not None:
                return pose
    return _find(image, (0, 0), view, marks)


def _find(part: Image, corner: tuple[int, int], view: PlaneView, marks: JawMarks) -> JawPose | None:
    middle = np.array([corner[0] + 0.5 * part.shape[1], corner[1] + 0.5 * part.shape[0]])
    radius_px = marks.radius_m * pixels_per_metre(view, middle)
    centres = _discs(part, radius_px)
    if len(centres) < 3:
        return None
    return _rigid_match(view.to_plane(centres + corner), marks)


def pixels_per_metre(view: PlaneView, pixel: FloatArray) -> float:
    """Local scale of a view at a pixel (2,)."""
    square = pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    p = view.to_plane(square)
    a, b = p[1] - p[0], p[2] - p[0]
    return float(1.0 / np.sqrt(abs(a[0] * b[1] - a[1] * b[0])))


def _discs(part: Image, radius_px: float) -> FloatArray:
    """(N, 2) centres, column and row, of light discs of about the given radius."""
    shrink = max(1, int(radius_px // 3.0))
    small = cv2.resize(
        part,
        (part.shape[1] // shrink, part.shape[0] // shrink),
        interpolation=cv2.INTER_AREA if shrink > 1 else cv2.INTER_NEAREST,
    )
    r = radius_px / shrink
    block = 2 * int(np.ceil(2.5 * r)) + 1
    light = cv2.adaptiveThreshold(
        small, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, block, -15
    )
    _, _, stats, middles = cv2.connectedComponentsWithStats(light, connectivity=4)
    area = np.pi * r * r
    wide, high = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
    size = stats[:, cv2.CC_STAT_AREA]
    keep = (size > 0.4 * area) & (size < 2.2 * area) & (np.maximum(wide, high) < 3.2 * r)
    found = [
        _disc_centre(part, centre, radius_px)
        for centre in (middles[keep] + 0.5) * shrink - 0.5
        if np.all(np.isfinite(centre))
    ]
    return np.array([c for c in found if c is not None]).reshape(-1, 2)


def _disc_centre(part: Image, about: FloatArray, radius_px: float) -> FloatArray | None:
    """Centroid of a light disc about a place, or None where there is no such disc."""
    centre = _centroid(part, float(about[0]), float(about[1]), radius_px)
    return None if np.isnan(centre[0]) else np.array(centre)


@njit(cache=True)
def _centroid(part, column, row, radius):  # type: ignore[no-untyped-def]
    """Column and row, nan where there is no disc: grey levels between inside and around count."""
    height, width = part.shape
    half = int(np.ceil(1.6 * radius))
    for _ in range(2):
        left, top = int(np.rint(column)), int(np.rint(row))
        if not (half <= left < width - half and half <= top < height - half):
            return np.nan, np.nan
        inside, around, insiders, outsiders = 0.0, 0.0, 0, 0
        for v in range(-half, half + 1):
            for u in range(-half, half + 1):
                distance = np.hypot(u - (column - left), v - (row - top)) / radius
                if distance < 0.5:
                    inside += part[top + v, left + u]
                    insiders += 1
                elif 1.25 < distance < 1.55:
                    around += part[top + v, left + u]
                    outsiders += 1
        inside /= insiders
        around /= outsiders
        if inside - around < 30.0:
            return np.nan, np.nan
        total, along, down = 0.0, 0.0, 0.0
        for v in range(-half, half + 1):
            for u in range(-half, half + 1):
                if np.hypot(u - (column - left), v - (row - top)) > 1.45 * radius:
                    continue
                share = (part[top + v, left + u] - around) / (inside - around)
                share = min(max(share, 0.0), 1.0)
                total += share
                along += share * u
                down += share * v
        if not 0.7 < total / (np.pi * radius * radius) < 1.4:
            return np.nan, np.nan
        column, row = left + along / total, top + down / total
    return column, row


def _rigid_match(points: FloatArray, marks: JawMarks) -> JawPose | None:
    """Best rigid fit of the marks to (N, 2) points in the plane, at least 3 of them agreeing."""
    model = np.asarray(marks.centres_m)
    best: tuple[int, float] = (2, 0.0)
    found: JawPose | None = None
    between = np.linalg.norm(points[:, None] - points[None], axis=2)
    for a, b in combinations(range(len(model)), 2):
        distance = float(np.linalg.norm(model[b] - model[a]))
        rows, columns = np.nonzero(np.abs(between - distance) < marks.tolerance_m)
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True):
            rotation, shift = _rigid_fit(model[[a, b]], points[[i, j]])
            off = np.linalg.norm((model @ rotation.T + shift)[:, None] - points[None], axis=2)
            nearest = off.argmin(axis=1)
            used = np.flatnonzero(off.min(axis=1) < 2.0 * marks.tolerance_m)
            if len(used) < 3 or len(used) < best[0] or len(set(nearest[used])) < len(used):
                continue
            rotation, shift = _rigid_fit(model[used], points[nearest[used]])
            misfit = model[used] @ rotation.T + shift - points[nearest[used]]
            rms = float(np.sqrt(np.mean(np.sum(misfit**2, axis=1))))
            if rms < marks.tolerance_m and (len(used), -rms) > best:
                best = (len(used), -rms)
                angle = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
                found = JawPose(shift, angle, len(used), rms)
                if len(used) == len(model):
                    return found
    return found


def _rigid_fit(model: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (2, 2) and shift (2,) of (N, 2) model points onto points, least squares."""
    m, p = model - model.mean(axis=0), points - points.mean(axis=0)
    angle = np.arctan2(np.sum(m[:, 0] * p[:, 1] - m[:, 1] * p[:, 0]), np.sum(m * p))
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    shift: FloatArray = points.mean(axis=0) - rotation @ model.mean(axis=0)
    return rotation, shift
