"""A thin line in a picture: where it starts, runs and ends, to a fraction of a pixel.

All positions are (column, row) in pixels, the centre of the first pixel at 0, 0.  A line may be
dark (`sign` = −1) or light (+1); a picture of the empty scene is taken off where one is given.
Compiled, and touching only pixels near the line, so that the picture's size costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]


class End(IntEnum):
    """Why following a line ended."""

    FADED = 0  # the line is no longer there: its end
    LEFT_PICTURE = 1
    TOO_LONG = 2


@dataclass(frozen=True)
class Picture:
    """What a line is looked for in.

    image       (H, W) grey levels
    background  (H, W) the same scene without the line, or None
    sign        +1 = the line is lighter than its surroundings, −1 = darker
    """

    image: Image
    background: Image | None
    sign: int

    @property
    def arrays(self) -> tuple[Image, Image, bool, float]:
        """What the compiled functions take."""
        if self.background is None:
            return self.image, self.image, False, float(self.sign)
        return self.image, self.background, True, float(self.sign)


def find_start(
    picture: Picture, at: FloatArray, direction: FloatArray, reach_px: float, slope: float = 0.5
) -> tuple[FloatArray, FloatArray, float]:
    """Where a line leaves a place about `at` (2,), heading about `direction` (2,).

    A fan of straight lines of ± `slope` and ± `reach_px` sideways is tried.
    returns  point (2,) beside `at`, unit direction (2,), contrast in grey levels
    """
    p, d, contrast = _find_start(*picture.arrays, at, direction, reach_px, slope)
    return p, d, float(contrast)


def follow(
    picture: Picture,
    start: FloatArray,
    direction: FloatArray,
    *,
    contrast: float,
    seen_share: float,
    step_px: float,
    gap_px: float,
    longest_px: float,
) -> tuple[FloatArray, FloatArray, End]:
    """Follow a line from `start` (2,) along `direction` (2,) until it ends.

    contrast    contrast at the start, grey levels
    seen_share  less than this share of the recent mean contrast = not seen
    gap_px      how long it may be unseen before it counts as ended
    returns     (N, 2) points about `step_px` apart, (N,) contrasts, why it ended
    """
    capacity = int(longest_px / step_px) + 2
    points = np.empty((capacity, 2))
    contrasts = np.empty(capacity)
    n, end = _follow(
        *picture.arrays, start, direction, contrast, seen_share, step_px, gap_px, points, contrasts
    )
    return points[:n], contrasts[:n], End(end)


def offsets_along(
    picture: Picture, points: FloatArray, normals: FloatArray, width_px: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far a line lies beside each of (M, 2) points, along (M, 2) unit normals.

    A Gaussian of standard deviation `width_px` on a sloping base is fitted to every profile by
    linear least squares: v ≈ a g − aδ g′ + b + c o.  One Gauss–Newton step from δ = 0.
    returns  (M,) offsets δ in px (nan where there is no line), (M,) amplitudes a, and (M,) the
             standard deviation of what the fit leaves, grey levels
    """
    design, solve = _profile_fit(width_px)
    offsets, amplitudes, left = _offsets(*picture.arrays, points, normals, solve, design)
    limit = 1.5 * width_px
    bad = (amplitudes <= 0.0) | ~(np.abs(offsets) < limit)
    return np.where(bad, np.nan, offsets), amplitudes, left


@lru_cache(maxsize=8)
def _profile_fit(width_px: float) -> tuple[FloatArray, FloatArray]:
    """(taps, 4) columns g, g′, 1, o of the profile's model, and their (4, taps) least squares."""
    half = max(4, int(np.ceil(4.0 * width_px)))
    o = np.arange(-half, half + 1, dtype=np.float64)
    g = np.exp(-0.5 * (o / width_px) ** 2)
    design = np.stack([g, -o / width_px**2 * g, np.ones_like(o), o], axis=1)
    return design, np.ascontiguousarray(np.linalg.pinv(design))


def crossings(
    picture: Picture, centre: FloatArray, radius_px: float, middle_rad: float, half_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Lines that cross an arc about `centre` (2,): (C, 2) points and (C,) contrasts.

    middle_rad  direction of the middle of the arc (from +column towards +row), half_rad half of it
    """
    found, contrasts = _crossings(*picture.arrays, centre, radius_px, middle_rad, half_rad)
    return found, contrasts


# --- compiled ---------------------------------------------------------------------------------


@njit(cache=True, inline="always")
def _level(image, background, subtract, sign, u, v):  # type: ignore[no-untyped-def]
    """Bilinear grey level, positive where the line is; nan outside the picture."""
    height, width = image.shape
    if not (u >= 0.0 and v >= 0.0 and u < width - 1.0 and v < height - 1.0):
        return np.nan
    i, j = int(u), int(v)
    a, b = u - i, v - j
    value = (1.0 - b) * ((1.0 - a) * image[j, i] + a * image[j, i + 1]) + b * (
        (1.0 - a) * image[j + 1, i] + a * image[j + 1, i + 1]
    )
    if subtract:
        value -= (1.0 - b) * ((1.0 - a) * background[j, i] + a * background[j, i + 1]) + b * (
            (1.0 - a) * background[j + 1, i] + a * background[j + 1, i + 1]
        )
    return sign * value


@njit(cache=True)
def _profile(image, background, subtract, sign, u, v, du, dv, reach, values):  # type: ignore[no-untyped-def]
    """Levels across a line at offsets −reach … reach, each the mean of three along the line."""
    for k in range(2 * reach + 1):
        o = float(k - reach)
        total = 0.0
        for t in (-1.0, 0.0, 1.0):
            total += _level(
                image, background, subtract, sign, u - o * dv + t * du, v + o * du + t * dv
            )
        values[k] = total / 3.0


@njit(cache=True, inline="always")
def _contrast(values, k):  # type: ignore[no-untyped-def]
    """Mean of three against the lighter of the two sides: an edge or a slope gives nothing."""
    middle = (values[k - 1] + values[k] + values[k + 1]) / 3.0
    left = (values[k - 6] + values[k - 5] + values[k - 4]) / 3.0
    right = (values[k + 6] + values[k + 5] + values[k + 4]) / 3.0
    return middle - max(left, right)


@njit(cache=True)
def _find_start(image, background, subtract, sign, at, direction, reach, slope):  # type: ignore[no-untyped-def]
    norm = np.hypot(direction[0], direction[1])
    du, dv = direction[0] / norm, direction[1] / norm
    best, best_o, best_s = -np.inf, 0.0, 0.0
    width = int(reach) + 1
    side = width + int(20 * slope) + 8
    rows = 10
    values = np.empty((rows, 2 * side + 1))
    for r in range(rows):
        d = 5.0 + 1.6 * r
        _profile(
            image,
            background,
            subtract,
            sign,
            at[0] + d * du,
            at[1] + d * dv,
            du,
            dv,
            side,
            values[r],
        )
    for shift in range(-width, width + 1):
        for turn in range(-10, 11):
            s = slope * turn / 10.0
            total = 0.0
            for r in range(rows):
                k = side + int(np.rint(shift + s * (5.0 + 1.6 * r)))
                total += _contrast(values[r], k)
            if total > best:
                best, best_o, best_s = total, float(shift), s
    point = np.array([at[0] - best_o * dv, at[1] + best_o * du])
    norm = np.sqrt(1.0 + best_s * best_s)
    heading = np.array([(du - best_s * dv) / norm, (dv + best_s * du) / norm])
    return point, heading, best / rows


@njit(cache=True)
def _follow(  # type: ignore[no-untyped-def]
    image, background, subtract, sign, start, direction, contrast, share, step, gap, points, found
):
    height, width = image.shape
    reach = 4
    side = reach + 6
    values = np.empty(2 * side + 1)
    u, v = start[0], start[1]
    du, dv = direction[0], direction[1]
    recent = contrast
    n = 0
    unseen = 0.0
    while n < len(points):
        u += step * du
        v += step * dv
        if u < 2.0 or v < 2.0 or u > width - 3.0 or v > height - 3.0:
            return n, 1 if unseen <= 2.0 * step else 0
        _profile(image, background, subtract, sign, u, v, du, dv, side, values)
        best, best_k = -np.inf, side
        near = min(reach, 2 + int(0.3 * unseen))
        for k in range(side - near, side + near + 1):
            c = _contrast(values, k) - 0.02 * recent * abs(k - side)
            if c > best:
                best, best_k = c, k
        if not best > share * recent:
            unseen += step
            if unseen > gap:
                return n, 0
            continue
        unseen = 0.0
        base = 0.25 * (
            values[best_k - 5] + values[best_k - 4] + values[best_k + 4] + values[best_k + 5]
        )
        weight, moment = 1e-9, 0.0
        for k in range(best_k - 3, best_k + 4):
            w = max(values[k] - base, 0.0)
            weight += w
            moment += w * (k - side)
        o = moment / weight
        u -= o * dv
        v += o * du
        points[n, 0], points[n, 1] = u, v
        found[n] = best
        recent += 0.1 * (best - recent)
        n += 1
        # heading from the last points, by least squares through a short stretch
        m = min(n, 10)
        if m >= 4:
            su, sv, st, sut, svt, stt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(m):
                a, b = points[n - m + i, 0], points[n - m + i, 1]
                su += a
                sv += b
                st += i
                sut += a * i
                svt += b * i
                stt += i * i
            hu, hv = m * sut - st * su, m * svt - st * sv
            norm = np.hypot(hu, hv)
            if norm > 0.0:
                du, dv = hu / norm, hv / norm
    return n, 2


@njit(cache=True)
def _offsets(image, background, subtract, sign, points, normals, solve, design):  # type: ignore[no-untyped-def]
    count, taps = len(points), solve.shape[1]
    offsets = np.empty(count)
    amplitudes = np.empty(count)
    left = np.empty(count)
    values = np.empty(taps)
    for i in range(count):
        for k in range(taps):
            o = k - taps // 2
            values[k] = _level(
                image,
                background,
                subtract,
                sign,
                points[i, 0] + o * normals[i, 0],
                points[i, 1] + o * normals[i, 1],
            )
        fit = np.zeros(4)
        for r in range(4):
            for k in range(taps):
                fit[r] += solve[r, k] * values[k]
        rest = 0.0
        for k in range(taps):
            e = values[k]
            for r in range(4):
                e -= design[k, r] * fit[r]
            rest += e * e
        amplitudes[i] = fit[0]
        offsets[i] = -fit[1] / fit[0] if fit[0] != 0.0 else np.nan
        left[i] = np.sqrt(rest / (taps - 4))
    return offsets, amplitudes, left


@njit(cache=True)
def _crossings(image, background, subtract, sign, centre, radius, middle, half):  # type: ignore[no-untyped-def]
    count = int(2.0 * half * radius) + 1
    values = np.empty(count)
    for k in range(count):
        a = middle - half + k / radius
        c, s = np.cos(a), np.sin(a)
        total = 0.0
        for t in (-1.0, 0.0, 1.0):
            r = radius + t
            total += _level(image, background, subtract, sign, centre[0] + r * c, centre[1] + r * s)
        values[k] = total / 3.0
    contrasts = np.full(count, -np.inf)
    for k in range(6, count - 6):
        c = _contrast(values, k)
        if c > 0.0:
            contrasts[k] = c
    points = np.empty((64, 2))
    strength = np.empty(64)
    n = 0
    for k in range(6, count - 6):
        peak = contrasts[k] > 0.0
        for j in range(max(0, k - 5), min(count, k + 6)):
            if contrasts[j] > contrasts[k] or (contrasts[j] == contrasts[k] and j < k):
                peak = False
        if peak and n < 64:
            a = middle - half + k / radius
            points[n, 0] = centre[0] + radius * np.cos(a)
            points[n, 1] = centre[1] + radius * np.sin(a)
            strength[n] = contrasts[k]
            n += 1
    return points[:n], strength[:n]
