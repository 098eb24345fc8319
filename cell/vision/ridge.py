"""A thin line in a picture: its start, course and end, to a fraction of a pixel.

All positions are (column, row) in pixels, the centre of the first pixel at 0, 0.  A line may be
dark (`sign` = −1) or light (+1).
Compiled; only pixels near the line are read, so the time does not depend on the picture's size.
"""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.vision.compiling import hypot, inline, part

Image = NDArray[np.uint8]


class End(IntEnum):
    """Reason why following a line ended."""

    FADED = 0  # the line is no longer there: its end
    LEFT_PICTURE = 1
    TOO_LONG = 2


class GreyImage(NamedTuple):
    """A picture to be searched for a line.

    image  (H, W) grey levels
    sign   +1 = the line is lighter than its surroundings, −1 = darker
    """

    image: Image
    sign: float

    @classmethod
    def of(cls, image: Image, sign: int) -> GreyImage:
        """A picture; copied only where it is not contiguous."""
        return cls(np.require(image, requirements=["C", "W"]), float(sign))


class RidgeStart(NamedTuple):
    """A place (column, row) on a line, a unit direction along it, and the contrast, grey levels."""

    u: float
    v: float
    du: float
    dv: float
    contrast: float


class ProfileFit(NamedTuple):
    """A Gaussian of standard deviation `width_px` on a sloping base, fitted to profiles of a line.

    v ≈ a g − aδ g′ + b + c o at `taps` offsets o across the line, by linear least squares: one
    Gauss–Newton step from δ = 0.

    rows  (taps, 8) columns g, g′, 1, o, then the least squares of these four, transposed
    """

    rows: FloatArray
    width_px: float


@lru_cache(maxsize=8)
def profile_fit(width_px: float) -> ProfileFit:
    """See `ProfileFit`."""
    half = max(4, int(np.ceil(4.0 * width_px)))
    o = np.arange(-half, half + 1, dtype=np.float64)
    g = np.exp(-0.5 * (o / width_px) ** 2)
    design = np.stack([g, -o / width_px**2 * g, np.ones_like(o), o], axis=1)
    return ProfileFit(np.hstack([design, np.linalg.pinv(design).T]), width_px)


_FAN_ROWS = 10  # profiles in the search for a line's start
_REACH = 4  # largest offset of the next point from the line's heading, px
_SIDE = _REACH + 6  # of a profile, px


def new_scratch(longest: int = 0) -> FloatArray:
    """(10, ≥ longest) memory that the functions below need."""
    return np.empty((_FAN_ROWS, max(longest, 80)))


@inline
def _level(picture, u, v):  # type: ignore[no-untyped-def]
    """Bilinear grey level, positive where the line is; nan outside the picture."""
    height, width = picture.image.shape
    if not (u >= 0.0 and v >= 0.0 and u < width - 1.0 and v < height - 1.0):
        return np.nan
    i, j = np.uint32(u), np.uint32(v)
    a, b = u - i, v - j
    image = picture.image
    upper = image[j, i] + a * (np.int32(image[j, i + 1]) - np.int32(image[j, i]))
    lower = image[j + 1, i] + a * (np.int32(image[j + 1, i + 1]) - np.int32(image[j + 1, i]))
    return picture.sign * (upper + b * (lower - upper))


@part
def _profile(picture, u, v, du, dv, scratch, row, taps):  # type: ignore[no-untyped-def]
    """Levels across a line, a pixel apart, about (u, v), into a row of memory.

    Each is the mean of three along the line, whose direction is (du, dv).
    """
    for k in range(taps):
        o = float(k - taps // 2)
        total = 0.0
        for t in (-1.0, 0.0, 1.0):
            total += _level(picture, u - o * dv + t * du, v + o * du + t * dv)
        scratch[row, k] = total / 3.0


@inline
def _contrast(scratch, row, k):  # type: ignore[no-untyped-def]
    """Mean of three minus that of the lighter side: 0 or less at an edge or on a slope."""
    middle = (scratch[row, k - 1] + scratch[row, k] + scratch[row, k + 1]) / 3.0
    left = (scratch[row, k - 6] + scratch[row, k - 5] + scratch[row, k - 4]) / 3.0
    right = (scratch[row, k + 6] + scratch[row, k + 5] + scratch[row, k + 4]) / 3.0
    return middle - max(left, right)


@part
def find_start(picture, at, direction, reach, slope, scratch):  # type: ignore[no-untyped-def]
    """The start of a line near the place `at`, heading about `direction` (column, row each).

    A fan of straight lines of ± `slope` and ± `reach` pixels sideways is tried.
    scratch  memory, see `new_scratch`; it suffices for reach ≤ 6 and slope ≤ 1
    returns  a `RidgeStart` near `at`
    """
    norm = hypot(direction[0], direction[1])
    du, dv = direction[0] / norm, direction[1] / norm
    best, best_o, best_s = -np.inf, 0.0, 0.0
    width = int(reach) + 1
    side = width + int(20 * slope) + 8
    taps = 2 * side + 1
    for r in range(_FAN_ROWS):
        d = 5.0 + 1.6 * r
        _profile(picture, at[0] + d * du, at[1] + d * dv, du, dv, scratch, r, taps)
    for shift in range(-width, width + 1):
        for turn in range(-10, 11):
            s = slope * turn / 10.0
            total = 0.0
            for r in range(_FAN_ROWS):
                k = side + int(np.rint(shift + s * (5.0 + 1.6 * r)))
                total += _contrast(scratch, r, k)
            if total > best:
                best, best_o, best_s = total, float(shift), s
    norm = np.sqrt(1.0 + best_s * best_s)
    return RidgeStart(
        at[0] - best_o * dv,
        at[1] + best_o * du,
        (du - best_s * dv) / norm,
        (dv + best_s * du) / norm,
        best / _FAN_ROWS,
    )


@inline
def _heading(line, n, du, dv):  # type: ignore[no-untyped-def]
    """Direction of the last of n points, by least squares through a short stretch."""
    m = min(n, 10)
    if m < 4:
        return du, dv
    su, sv, st, sut, svt, stt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(m):
        a, b = line[n - m + i, 0], line[n - m + i, 1]
        su += a
        sv += b
        st += i
        sut += a * i
        svt += b * i
        stt += i * i
    hu, hv = m * sut - st * su, m * svt - st * sv
    norm = hypot(hu, hv)
    if norm > 0.0:
        return hu / norm, hv / norm
    return du, dv


@part
def follow(picture, start, share, step, gap, line, scratch):  # type: ignore[no-untyped-def]
    """Follow a line from a `RidgeStart` until it ends, or `line` is full.

    share    least contrast of a detected point, relative to the recent mean contrast
    step     between points, px
    gap      longest stretch without a detected point before the line counts as ended, px
    line     (capacity, ≥ 3) column, row and contrast of every point, `step` apart; is written
    scratch  memory, see `new_scratch`
    returns  number of points, and the reason for the end, see `End`
    """
    height, width = picture.image.shape
    u, v, du, dv, recent = start
    n = 0
    unseen = 0.0
    while n < len(line):
        u += step * du
        v += step * dv
        if u < 2.0 or v < 2.0 or u > width - 3.0 or v > height - 3.0:
            return n, 1 if unseen <= 2.0 * step else 0
        _profile(picture, u, v, du, dv, scratch, 0, 2 * _SIDE + 1)
        best, best_k = -np.inf, _SIDE
        near = min(_REACH, 2 + int(0.3 * unseen))
        for k in range(_SIDE - near, _SIDE + near + 1):
            c = _contrast(scratch, 0, k) - 0.02 * recent * abs(k - _SIDE)
            if c > best:
                best, best_k = c, k
        if not best > share * recent:
            unseen += step
            if unseen > gap:
                return n, 0
            continue
        unseen = 0.0
        base = 0.25 * (scratch[0, best_k - 5] + scratch[0, best_k - 4])
        base += 0.25 * (scratch[0, best_k + 4] + scratch[0, best_k + 5])
        weight, moment = 1e-9, 0.0
        for k in range(best_k - 3, best_k + 4):
            w = max(scratch[0, k] - base, 0.0)
            weight += w
            moment += w * (k - _SIDE)
        o = moment / weight
        if np.isnan(o):  # the profile reaches beyond the picture
            return n, 1
        u -= o * dv
        v += o * du
        line[n, 0], line[n, 1], line[n, 2] = u, v, best
        recent += 0.1 * (best - recent)
        n += 1
        du, dv = _heading(line, n, du, dv)
    return n, 2


@inline
def offset_at(picture, u, v, nu, nv, fit, scratch):  # type: ignore[no-untyped-def]
    """Offset of a line from (u, v) along the unit normal (nu, nv), by a `ProfileFit`.

    scratch  memory, of which the last row is written
    returns  offset δ in px (nan where there is no line), amplitude a, and the standard deviation
             of the fit's residual, grey levels
    """
    taps, values, row = len(fit.rows), _FAN_ROWS - 1, fit.rows
    amplitude, moved, level, tilt = 0.0, 0.0, 0.0, 0.0
    for k in range(taps):
        o = k - taps // 2
        value = _level(picture, u + o * nu, v + o * nv)
        scratch[values, k] = value
        amplitude += row[k, 4] * value
        moved += row[k, 5] * value
        level += row[k, 6] * value
        tilt += row[k, 7] * value
    squares = 0.0
    for k in range(taps):
        expected = row[k, 0] * amplitude + row[k, 1] * moved + row[k, 2] * level + row[k, 3] * tilt
        e = scratch[values, k] - expected
        squares += e * e
    offset = -moved / amplitude
    if amplitude <= 0.0 or not abs(offset) < 1.5 * fit.width_px:
        offset = np.nan
    return offset, amplitude, np.sqrt(squares / (taps - 4))


@part
def crossings(picture, arc, scratch, points):  # type: ignore[no-untyped-def]
    """Lines that cross an arc about a place.

    arc      column and row of the place, radius in px, direction of the middle of the arc (from
             +column towards +row) and half of its angle, rad
    scratch  (≥ 2, ≥ 2 half radius + 1) memory
    points   (capacity, 3) column, row and contrast of every crossing; is written
    returns  number of crossings
    """
    centre_u, centre_v, radius, middle, half = arc
    count = min(int(2.0 * half * radius) + 1, scratch.shape[1])
    levels, contrasts = 0, 1  # rows of memory
    step_c, step_s = np.cos(1.0 / radius), np.sin(1.0 / radius)
    c, s = np.cos(middle - half), np.sin(middle - half)
    for k in range(count):
        total = 0.0
        for t in (-1.0, 0.0, 1.0):
            r = radius + t
            total += _level(picture, centre_u + r * c, centre_v + r * s)
        scratch[levels, k] = total / 3.0
        c, s = c * step_c - s * step_s, s * step_c + c * step_s
    for k in range(count):
        scratch[contrasts, k] = 0.0
        if 6 <= k < count - 6:
            scratch[contrasts, k] = max(_contrast(scratch, levels, k), 0.0)
    n = 0
    for k in range(6, count - 6):
        contrast = scratch[contrasts, k]
        peak = contrast > 0.0 and n < len(points)
        for j in range(max(0, k - 5), min(count, k + 6)):
            neighbour = scratch[contrasts, j]
            if neighbour > contrast or (neighbour == contrast and j < k):
                peak = False
        if peak:
            a = middle - half + k / radius
            points[n, 0] = centre_u + radius * np.cos(a)
            points[n, 1] = centre_v + radius * np.sin(a)
            points[n, 2] = contrast
            n += 1
    return n
