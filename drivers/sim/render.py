"""The picture that a side camera takes of the jaw and of the cable seen edge-on.

Light is gathered as polygons with exact area coverage: every polygon's edges are added to a buffer
whose running sum along a row is the covered share of each pixel.  The sum is linear, so motion blur
is the mean of a few displaced copies.  Then come the lens (a Gaussian), exposure, shot and read
noise, and eight bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from drivers.interfaces import FloatArray
from drivers.sim.pinhole import Sight, metres_per_pixel, to_pixels

LightArray = NDArray[np.float32]
Image = NDArray[np.uint8]

#: Discs on the jaw plate as (x_m, y_m, radius_m) in the jaw's frame: origin at the gripping point,
#: the cable leaves towards −x.  All six distances differ, so position and direction are unique.
JAW_MARKS_M = (
    (0.006, 0.009, 0.0025),
    (0.006, -0.009, 0.0025),
    (0.032, 0.009, 0.0025),
    (0.025, -0.003, 0.0025),
)

_NOISE_SCALE = 32.0  # the noise bank holds standard normal numbers as int8 / 32
_NOISE_SHIFTS = 1 << 19  # starting points within the bank


@dataclass(frozen=True)
class RenderOptions:
    """Properties of a rendered picture; grey levels 0 … 255 at exposure 1.

    Defaults: a backlit scene, the cable dark.  `LIGHT_ON_DARK` below is the opposite.
    """

    width_px: int = 1280
    height_px: int = 1024
    thickness_m: float = 0.0001
    cable_level: float = 25.0
    cable_glints: float = 0.15  # relative variation of the cable's brightness along its length
    background_level: float = 150.0
    illumination_drop: float = 0.3  # relative fall of the illumination across the picture
    texture_level: float = 4.0  # standard deviation of the background's texture
    bright_object: bool = True  # a static bright patch behind the cable
    plate_level: float = 35.0
    mark_level: float = 215.0
    plate_m: tuple[float, float, float, float] = (0.0, -0.013, 0.038, 0.013)  # x0, y0, x1, y1
    marks_m: tuple[tuple[float, float, float], ...] = JAW_MARKS_M
    lens_blur_px: float = 0.6  # standard deviation of the lens' and the focus' blur
    exposure: float = 1.0  # factor on the light; 0 = black frame, ≥ 3 = overexposed
    exposure_s: float = 0.0005  # for the motion blur
    read_noise: float = 1.0  # standard deviation, grey levels
    shot_noise: float = 0.025  # variance per grey level: 1 / (electrons per level)
    occluder_m: tuple[float, float, float, float] | None = None  # x0, y0, x1, y1 in the plane
    scene_seed: int = 0  # texture of the background

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px", "thickness_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"render.{name} = {getattr(self, name)}: must be > 0")
        for name in ("exposure", "exposure_s", "lens_blur_px", "read_noise", "shot_noise"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"render.{name} = {getattr(self, name)}: must be ≥ 0")


#: Pose of the jaw: x_m, y_m, angle_rad in the plane; or (4, 4) about it, for a `Pinhole` only.
GripPose = tuple[float, float, float] | FloatArray


@dataclass(frozen=True, eq=False)
class Patches:
    """Polygons of even grey level that stand in the scene, before the jaw and the cable.

    corners_m  (P, V, 2 or 3) convex polygons, 3 only for a `Pinhole`, m
    levels     (P,) light that each adds
    hides      (P,) share of the background that each hides: 0 = only adds its level
    """

    corners_m: FloatArray
    levels: FloatArray
    hides: FloatArray


#: A lit cable in front of a dark background.
LIGHT_ON_DARK = RenderOptions(cable_level=230.0, background_level=28.0, texture_level=2.0)


@dataclass(frozen=True, eq=False)
class Rates:
    """Velocity (K, 2) of a cable's centreline, m/s, and rates of a grip's x, y and angle."""

    cable_m_per_s: FloatArray | None = None
    grip_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)


STILL = Rates()


def render(
    cable_m: FloatArray | None,
    grip: GripPose | None,
    sight: Sight,
    options: RenderOptions,
    rng: np.random.Generator,
    *,
    rates: Rates = STILL,
    second_cable_m: FloatArray | None = None,
    behind: LightArray | None = None,
) -> Image:
    """One frame of the jaw and the cable in the cell's plane, about 1 ms.

    cable_m         (K, 2) centreline, tip first, ending at the gripping point, m; None = no cable
    grip            of the gripping point (positive angle = pointing down); None = no jaw
    sight           (3, 3) pixel (column, row; centre of the first pixel 0, 0) → plane, m, or a
                    camera that stands anywhere and has a lens
    rng             noise of this frame
    rates           for motion blur; the frame's time is the middle of the exposure
    second_cable_m  (K, 2) another cable in the picture
    behind          background, by `backdrop`; None = the empty scene
    returns         (height_px, width_px) uint8
    raises          ValueError: shapes disagree
    """
    polygons = _Polygons(sight)
    copies = _copies(cable_m, rates, sight, options)
    for share in (np.arange(copies) + 0.5) / copies - 0.5:
        later_s = float(share) * options.exposure_s
        if grip is not None:
            polygons.add_jaw(_moved(grip, rates.grip_per_s, later_s), options, 1.0 / copies)
        if cable_m is not None:
            moves = rates.cable_m_per_s
            line = cable_m if moves is None else cable_m + later_s * moves
            polygons.add_strip(line, options, 1.0 / copies)
    if second_cable_m is not None:
        polygons.add_strip(second_cable_m, options, 1.0)
    if options.occluder_m is not None:
        polygons.add_rectangle(options.occluder_m, (0.0, 0.0, 0.0), options.plate_level, 1.0)

    scene = _background(options) if behind is None else behind
    bank = _noise_bank(options.width_px * options.height_px)
    noise = bank[int(rng.integers(_NOISE_SHIFTS)) :]
    sensor = (
        np.float32(options.exposure),
        np.float32(options.read_noise**2),
        np.float32(options.shot_noise),
    )
    image: Image = np.empty((options.height_px, options.width_px), dtype=np.uint8)
    _expose(scene, 0, 0, noise, *sensor, image)
    drawn = polygons.drawn_over(scene, options.lens_blur_px)
    if drawn is not None:
        _expose(drawn.light, drawn.row, drawn.column, noise, *sensor, image)
    return image


def backdrop(patches: Sequence[Patches], sight: Sight, options: RenderOptions) -> LightArray:
    """(height_px, width_px) light of the scene with patches in it, the nearest last.

    A board has a thousand patches, so for several pictures it is drawn only once.
    """
    polygons = _Polygons(sight)
    for patch in patches:
        polygons.add(patch.corners_m, patch.levels, patch.hides, 1.0)
    light = _background(options).copy()
    drawn = polygons.drawn_over(light, options.lens_blur_px)
    if drawn is not None:
        rows, columns = drawn.light.shape
        light[drawn.row : drawn.row + rows, drawn.column : drawn.column + columns] = drawn.light
    return light


# --- light ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Part:
    """Part of a picture's light, and where its first pixel is."""

    row: int
    column: int
    light: LightArray


class _Polygons:
    """Polygons in pixels, each with its grey level and its weight; drawn together at the end."""

    def __init__(self, sight: Sight) -> None:
        self._sight = sight
        self._corners_m: list[FloatArray] = []  # (P, V, 2 or 3) each
        self._levels: list[FloatArray] = []  # (P,) light each adds where it covers
        self._hides: list[FloatArray] = []  # (P,) share of the background each hides

    def add(
        self, corners_m: FloatArray, level: FloatArray, hides: float | FloatArray, weight: float
    ) -> None:
        """(P, V, 2 or 3) convex polygons, m."""
        self._corners_m.append(corners_m)
        self._levels.append(np.asarray(weight * level, dtype=np.float64))
        self._hides.append(weight * np.broadcast_to(np.float64(hides), len(level)))

    def add_rectangle(
        self,
        rectangle_m: tuple[float, float, float, float],
        pose: GripPose,
        level: float,
        weight: float,
    ) -> None:
        x0, y0, x1, y1 = rectangle_m
        corners = _placed(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), pose)
        self.add(corners[None], np.array([level]), 1.0, weight)

    def add_jaw(self, pose: GripPose, options: RenderOptions, weight: float) -> None:
        self.add_rectangle(options.plate_m, pose, options.plate_level, weight)
        marks = np.asarray(options.marks_m)
        discs = marks[:, None, :2] + marks[:, 2, None, None] * _CIRCLE
        # a disc lies on the plate: it adds its contrast to the plate and hides nothing more
        contrast = np.full(len(marks), options.mark_level - options.plate_level)
        self.add(_placed(discs, pose), contrast, 0.0, weight)

    def add_strip(self, line_m: FloatArray, options: RenderOptions, weight: float) -> None:
        line = np.asarray(line_m, dtype=np.float64)
        if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2:
            raise ValueError(f"render: centreline has shape {line.shape}, needs (K ≥ 2, 2)")
        tangent = np.gradient(line, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        side = 0.5 * options.thickness_m * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        left, right = line + side, line - side
        quads = np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
        share = np.linspace(0.0, 1.0, len(quads))
        glints = 1.0 + options.cable_glints * np.sin(2 * np.pi * 5.3 * share) * np.cos(23 * share)
        self.add(quads, options.cable_level * glints, 1.0, weight)

    def drawn_over(self, background: LightArray, blur_px: float) -> _Part | None:
        """The part of the background that is drawn over, blurred by the lens; None = nothing is.

        Most of a picture is background: copying all of it would take as long as its exposure.
        """
        if not self._corners_m:
            return None
        in_pixels = self._in_pixels()
        height, width = background.shape
        margin = 4 + ceil(4.0 * blur_px)
        every = np.concatenate([c.reshape(-1, 2) for c in in_pixels])
        low = np.clip(np.floor(every.min(0)) - margin, -margin, [width, height]).astype(int)
        high = np.clip(np.ceil(every.max(0)) + margin, 0, [width + margin, height + margin])
        columns, rows = (high.astype(int) - low).tolist()
        if columns <= 0 or rows <= 0:
            return None
        added = np.zeros((rows, columns + 2), dtype=np.float32)
        hidden = np.zeros((rows, columns + 2), dtype=np.float32)
        for corners, levels, hides in zip(in_pixels, self._levels, self._hides, strict=True):
            gather(corners - low + 0.5, levels, hides, added, hidden)
        running_sum(added)
        running_sum(hidden)
        if blur_px > 0.0:
            size = 2 * ceil(3.0 * blur_px) + 1
            added = cv2.GaussianBlur(added, (size, size), blur_px)
            hidden = cv2.GaussianBlur(hidden, (size, size), blur_px)
        inside = slice(max(low[1], 0), min(low[1] + rows, height))
        across = slice(max(low[0], 0), min(low[0] + columns, width))
        part = (
            slice(inside.start - low[1], inside.stop - low[1]),
            slice(across.start - low[0], across.stop - low[0]),
        )
        light = background[inside, across].copy()
        lay_over(light, added[part], hidden[part])
        return _Part(inside.start, across.start, light)

    def _in_pixels(self) -> list[FloatArray]:
        """Corners (P, V, 2) of every addition; all of the plane's points are mapped at once."""
        found = list(self._corners_m)
        for size in {corners.shape[-1] for corners in found}:
            which = [k for k, corners in enumerate(found) if corners.shape[-1] == size]
            flat = np.concatenate([found[k].reshape(-1, size) for k in which])
            ends = np.cumsum([found[k].size // size for k in which])
            parts = np.split(to_pixels(self._sight, flat), ends[:-1])
            for k, pixels in zip(which, parts, strict=True):
                found[k] = pixels.reshape(*found[k].shape[:-1], 2)
        return found


_ANGLES = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def _placed(points: FloatArray, pose: GripPose) -> FloatArray:
    if isinstance(pose, np.ndarray):
        about: FloatArray = points @ pose[:3, :2].T + pose[:3, 3]
        return about
    x, y, angle = pose
    c, s = np.cos(angle), np.sin(angle)
    turned: FloatArray = points @ np.array([[c, s], [-s, c]]) + [x, y]
    return turned


def _moved(pose: GripPose, rate: tuple[float, float, float], later_s: float) -> GripPose:
    if isinstance(pose, np.ndarray):
        return pose  # shown at rest
    return (
        pose[0] + later_s * rate[0],
        pose[1] + later_s * rate[1],
        pose[2] + later_s * rate[2],
    )


def _copies(cable_m: FloatArray | None, rates: Rates, sight: Sight, options: RenderOptions) -> int:
    """How many displaced copies make a smooth motion blur: one per half pixel, at most 16."""
    cable_m_per_s, grip_per_s = rates.cable_m_per_s, rates.grip_per_s
    speed = float(np.hypot(grip_per_s[0], grip_per_s[1])) + 0.04 * abs(grip_per_s[2])
    if cable_m is not None and cable_m_per_s is not None:
        if np.shape(cable_m_per_s) != np.shape(cable_m):
            raise ValueError(
                f"render: cable_m {np.shape(cable_m)} and cable_m_per_s"
                f" {np.shape(cable_m_per_s)} must have the same shape"
            )
        speed = max(speed, float(np.linalg.norm(cable_m_per_s, axis=1).max()))
    blur_px = speed * options.exposure_s / metres_per_pixel(sight)
    return int(np.clip(ceil(2.0 * blur_px), 1, 16))


# --- scene and sensor -------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _background(options: RenderOptions) -> LightArray:
    """(height, width) light of the empty scene at exposure 1."""
    rng = np.random.default_rng(options.scene_seed)
    width, height = options.width_px, options.height_px
    u = np.linspace(-0.5, 0.5, width, dtype=np.float32)[None, :]
    v = np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None]
    fall = 0.6 * u + 0.3 * v + 0.8 * (u * u + v * v)
    light = options.background_level * (1.0 - options.illumination_drop * fall)
    for grain_px, share in ((90, 0.8), (7, 0.6)):
        shape = (height // grain_px + 3, width // grain_px + 3)
        coarse = rng.standard_normal(shape).astype(np.float32)
        fine = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        light += options.texture_level * share * fine / fine.std()
    if options.bright_object:
        patch = np.zeros((height, width), dtype=np.float32)
        centre = (int(0.12 * width), int(0.85 * height))
        cv2.ellipse(patch, centre, (width // 16, height // 24), 20.0, 0.0, 360.0, 1.0, -1)
        light += 70.0 * cv2.GaussianBlur(patch, (9, 9), 2.0)
    return np.ascontiguousarray(np.maximum(light, 0.0), dtype=np.float32)


@lru_cache(maxsize=2)
def _noise_bank(pixels: int) -> NDArray[np.int8]:
    normal = np.random.default_rng(1).standard_normal(pixels + _NOISE_SHIFTS, dtype=np.float32)
    bank: NDArray[np.int8] = np.clip(np.rint(normal * _NOISE_SCALE), -127, 127).astype(np.int8)
    return bank


@njit(cache=True, fastmath=True)
def _expose(light, top, left, noise, exposure, read_var, shot, image):  # type: ignore[no-untyped-def]
    """Pixels of (rows, columns) light whose first is at (top, left); each has noise of its own."""
    unit = np.float32(1.0 / 32.0)
    half, high, zero = np.float32(0.5), np.float32(255.0), np.float32(0.0)
    for r in range(light.shape[0]):
        own = noise[(top + r) * image.shape[1] + left :]
        row = image[top + r, left:]
        for c in range(light.shape[1]):
            level = light[r, c] * exposure
            level += np.float32(own[c]) * unit * np.sqrt(read_var + shot * level) + half
            row[c] = np.uint8(min(max(level, zero), high))


@njit(cache=True)
def gather(corners, levels, hides, added, hidden):  # type: ignore[no-untyped-def]
    """Add the edges of (P, V, 2) polygons; pixel (row, column) covers [column, column + 1]."""
    rows, columns = added.shape[0], added.shape[1] - 2
    for p in range(corners.shape[0]):
        count = corners.shape[1]
        area = 0.0
        for v in range(count):
            w = (v + 1) % count
            area += corners[p, v, 0] * corners[p, w, 1] - corners[p, w, 0] * corners[p, v, 1]
        turn = 1.0 if area < 0.0 else -1.0
        for v in range(count):
            w = (v + 1) % count
            x0, y0 = corners[p, v, 0], corners[p, v, 1]
            x1, y1 = corners[p, w, 0], corners[p, w, 1]
            if y0 == y1:
                continue
            sign = turn
            if y0 > y1:
                x0, y0, x1, y1 = x1, y1, x0, y0
                sign = -turn
            slope = (x1 - x0) / (y1 - y0)
            for row in range(max(0, int(np.floor(y0))), min(rows, int(np.ceil(y1)))):
                top, bottom = max(y0, float(row)), min(y1, row + 1.0)
                a = x0 + slope * (top - y0)
                b = x0 + slope * (bottom - y0)
                a = min(max(a, 0.0), float(columns))
                b = min(max(b, 0.0), float(columns))
                if a > b:
                    a, b = b, a
                _edge(added, row, a, b, sign * (bottom - top) * levels[p])
                _edge(hidden, row, a, b, sign * (bottom - top) * hides[p])


@njit(cache=True, inline="always")
def _edge(buffer, row, a, b, weight):  # type: ignore[no-untyped-def]
    """Share of each pixel to the right of an edge that runs from column a to b within a row."""
    first, last = int(a), int(b)
    if first == last:
        middle = 0.5 * (a + b) - first
        buffer[row, first] += weight * (1.0 - middle)
        buffer[row, first + 1] += weight * middle
        return
    per_column = weight / (b - a)
    before = 0.0  # covered so far, up to and including the pixel before
    for column in range(first, last + 1):
        left, right = max(a, float(column)), min(b, column + 1.0)
        # to the right of the edge within this pixel, plus all that crossed before it
        crossed = per_column * (right - left)
        covered = crossed * (column + 1.0 - 0.5 * (left + right))
        start = per_column * (left - a)
        buffer[row, column] += start + covered - before
        before = start + covered
    buffer[row, last + 1] += weight - before


@njit(cache=True)
def running_sum(buffer):  # type: ignore[no-untyped-def]
    """Sum along every row, in place."""
    for row in range(buffer.shape[0]):
        total = np.float64(0.0)
        for column in range(buffer.shape[1]):
            total += buffer[row, column]
            buffer[row, column] = total


@njit(cache=True)
def lay_over(light, added, hidden):  # type: ignore[no-untyped-def]
    """Take from light (rows, columns) the share that is hidden, and add to it, in place."""
    one = np.float32(1.0)
    for row in range(light.shape[0]):
        for column in range(light.shape[1]):
            light[row, column] *= one - min(hidden[row, column], one)
            light[row, column] += added[row, column]
