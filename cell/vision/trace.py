"""The held cable in one picture: it is followed from the grip, its tip detected, its curve fitted.

Compiled.  Everything here is in pixels (column, row); `detect` puts it into the cell's plane.
"""

from __future__ import annotations

from math import erfc, sqrt
from typing import NamedTuple

import numpy as np

from cell.cable.arrays import FloatArray
from cell.vision.compiling import hypot, inline, part
from cell.vision.ridge import (
    ProfileFit,
    RidgeStart,
    find_start,
    follow,
    new_scratch,
    offset_at,
    profile_fit,
)
from cell.vision.sighting import UNSEEN, Unseen
from cell.vision.spline import (
    COLUMN,
    PARAMETER,
    ROW,
    STRENGTH,
    WEIGHT,
    at,
    fit_cable,
    new_equations,
    new_pieces,
)

SAMPLES = 400  # along the cable, at which offsets are measured
DENSE = 401  # points along the cable, 0.25 mm apart
_FINE = 2 * SAMPLES  # points between which equal arc length is interpolated
_START_PX = 4.0  # from the jaw, within which a profile includes the jaw
_END_PX = 2.0  # from the tip, within which it includes the tip's blur
_MIN_DETECTED = 0.7  # of the cable's length; less would be guessing
STEP_PX = 2.0  # from point to point of a line that is followed
_TIP_FROM_PX, _TIP_TO_PX = -50, 14  # range about the followed line's end to search for the tip
ARC_RAD = 1.75  # half angle of the arcs that are searched for a second cable
_CROSSINGS = 64  # lines across one arc
_LONGEST = 1.3  # largest followed length of a cable, times its expected length

_AT_U, _AT_V, _NORMAL_U, _NORMAL_V, _NOISE = range(5, 10)  # columns of the samples
_ALONG, _SHARE = 1, 2  # rows of memory in the search for the tip

SEEN = -1
_NO_CABLE = UNSEEN.index(Unseen.NO_CABLE)
_LEAVES_PICTURE = UNSEEN.index(Unseen.LEAVES_PICTURE)


class CableAppearance(NamedTuple):
    """Appearance of a cable: least contrast at its start, grey levels, and its profile.

    at_tip  profile for the search for the tip
    """

    min_contrast: float
    along: ProfileFit
    at_tip: ProfileFit


class TraceMemory(NamedTuple):
    """Memory for following and measuring a cable; it holds the resulting curve.

    line       (capacity, 5) points of a followed line; columns as in `spline`
    samples    (SAMPLES, 10) the same for measured points, then the place and the normal of the
               curve at which each was measured, and the noise of its profile
    pieces     of the curve
    dense      (DENSE, 2) points of the curve, at equal parameters
    crossing   (64, 3) crossings of lines with an arc
    equations  of the curve's fit
    scratch    (10, …) for one step at a time
    """

    line: FloatArray
    samples: FloatArray
    pieces: FloatArray
    dense: FloatArray
    crossing: FloatArray
    equations: FloatArray
    scratch: FloatArray


class Traced(NamedTuple):
    """Result of following a cable: its code, and measures of its quality.

    code             −1, or the index of its `Unseen`
    contrast         typical contrast, grey levels
    detected_share   share of its length along which it was detected
    misfit_px        rms distance of the measured points from the curve
    signal_to_noise  amplitude of the line's profile over the residual of the profile's fit
    """

    code: int
    contrast: float
    detected_share: float
    misfit_px: float
    signal_to_noise: float


def cable_appearance(min_contrast: float, width_px: float) -> CableAppearance:
    """See `CableAppearance`; width_px is the standard deviation of the cable's profile."""
    return CableAppearance(float(min_contrast), profile_fit(width_px), profile_fit(1.2 * width_px))


def trace_memory(diagonal_px: float) -> TraceMemory:
    """Memory for pictures of a diagonal; a bent cable is at most twice as long."""
    longest_px = 2.0 * diagonal_px
    capacity = max(int(_LONGEST * longest_px / STEP_PX) + 3, SAMPLES)
    return TraceMemory(
        line=np.empty((capacity, 5)),
        samples=np.empty((SAMPLES, 10)),
        pieces=new_pieces(),
        dense=np.empty((DENSE, 2)),
        crossing=np.empty((_CROSSINGS, 3)),
        equations=new_equations(),
        scratch=new_scratch(max(int(2.0 * ARC_RAD * longest_px) + 2, _FINE, capacity)),
    )


@part
def trace_cable(picture, appearance, memory, grip, outward, length):  # type: ignore[no-untyped-def]
    """Trace of the cable that leaves the gripping point about along `outward` (column, row each).

    appearance  of the cable, see `CableAppearance`
    memory   see `TraceMemory`; the cable's curve is written to it
    length   expected, px
    returns  a `Traced`, its code among: NO_CABLE (also when too little of it is detected),
             LEAVES_PICTURE
    """
    height, width = picture.image.shape
    if not (2.0 < grip[0] < width - 3.0 and 2.0 < grip[1] < height - 3.0):
        return Traced(_LEAVES_PICTURE, 0.0, 0.0, 0.0, 0.0)
    start = find_start(picture, grip, outward, 3.0, 0.5, memory.scratch)
    if not start.contrast >= appearance.min_contrast:
        return Traced(_NO_CABLE, 0.0, 0.0, 0.0, 0.0)
    u, v = start.u + 3.0 * start.du, start.v + 3.0 * start.dv
    begin = RidgeStart(u, v, start.du, start.dv, start.contrast)
    capacity = min(int(_LONGEST * length / STEP_PX) + 2, len(memory.line) - 1)
    line = memory.line[: capacity + 1]
    line[0, COLUMN], line[0, ROW] = start.u, start.v
    count, end = follow(picture, begin, 0.4, STEP_PX, 0.03 * length, line[1:], memory.scratch)
    if end == 1:
        return Traced(_LEAVES_PICTURE, 0.0, 0.0, 0.0, 0.0)
    if count < 20:
        return Traced(_NO_CABLE, 0.0, 0.0, 0.0, 0.0)
    line = line[: count + 1]
    _chord_parameters(line)
    for n in range(count + 1):
        line[n, WEIGHT] = 1.0 if n else 0.1
    fit_cable(line, memory.pieces, memory.equations)
    tip = _tip(picture, appearance.at_tip, memory)
    if np.isnan(tip):
        return Traced(_LEAVES_PICTURE, 0.0, 0.0, 0.0, 0.0)
    for n in range(count):
        memory.scratch[0, n] = line[n + 1, STRENGTH]
    contrast = median(memory.scratch, count)
    return _refined(picture, appearance.along, memory, grip, tip, contrast)


@part
def _chord_parameters(line):  # type: ignore[no-untyped-def]
    """Give the points of a line parameters 0 … 1, by distance."""
    total = 0.0
    line[0, PARAMETER] = 0.0
    for n in range(1, len(line)):
        across, down = line[n, COLUMN] - line[n - 1, COLUMN], line[n, ROW] - line[n - 1, ROW]
        total += hypot(across, down)
        line[n, PARAMETER] = total
    for n in range(len(line)):
        line[n, PARAMETER] /= total


@part
def _tip(picture, fit, memory):  # type: ignore[no-untyped-def]
    """Parameter at which the line ends, where its amplitude falls to half, to a part of a pixel.

    Least squares of amplitude ≈ full · Φ((end − along) / blur), which blur does not bias.
    fit      profile's fit; its blur is assumed to be 1.2 times that of the tip
    returns  the parameter, or nan where the line does not end in the picture
    """
    scratch = memory.scratch
    _, _, du, dv = at(memory.pieces, 0.97)
    speed = hypot(du, dv)
    count, inner = 0, 0
    for place in range(_TIP_FROM_PX, _TIP_TO_PX):
        # straight from a little before the end: the last few points may be off the line
        bent = min(float(place), -6.0)
        u, v, du, dv = at(memory.pieces, 1.0 + bent / speed)
        norm = hypot(du, dv)
        du, dv = du / norm, dv / norm
        ahead = place - bent
        _, amplitude, _ = offset_at(picture, u + ahead * du, v + ahead * dv, -dv, du, fit, scratch)
        if np.isfinite(amplitude):
            scratch[_ALONG, count], scratch[_SHARE, count] = place, amplitude
            scratch[0, count] = amplitude
            count += 1
            if place < -16.0:
                inner = count
    if count < 40:
        return np.nan
    full = max(median(scratch, inner), 1e-6)
    for n in range(count):
        scratch[_SHARE, n] /= full
    first_faded, faded = -1, 0
    for n in range(count):
        before, after = scratch[_SHARE, max(n - 1, 0)], scratch[_SHARE, min(n + 1, count - 1)]
        faded = faded + 1 if (before + scratch[_SHARE, n] + after) / 3.0 < 0.5 else 0
        if faded >= 3 and scratch[_ALONG, n - 2] > -40.0:
            first_faded = n - 2
            break
    if first_faded < 0:
        complete = count == _TIP_TO_PX - _TIP_FROM_PX
        return 1.0 + scratch[_ALONG, count - 1] / speed if complete else np.nan
    return 1.0 + _half(scratch, count, scratch[_ALONG, first_faded], fit.width_px / 1.2) / speed


@inline
def _half(scratch, count, end, blur):  # type: ignore[no-untyped-def]
    """Position at which the share falls to half, by Gauss–Newton from `end`."""
    for _ in range(5):
        numerator, denominator = 0.0, 0.0
        for n in range(count):
            z = (end - scratch[_ALONG, n]) / blur
            density = np.exp(-0.5 * z * z) / (sqrt(2.0 * np.pi) * blur)
            numerator += (scratch[_SHARE, n] - 0.5 * erfc(-z / sqrt(2.0))) * density
            denominator += density * density
        end = max(end + numerator / denominator, scratch[_ALONG, 0])
        end = min(end, scratch[_ALONG, count - 1])
    return end


@part
def _refined(picture, fit, memory, grip, tip, contrast):  # type: ignore[no-untyped-def]
    """The curve refitted to offsets across it, sampled at equal arc length from grip to tip."""
    last = tip
    usable, clear = 0, 0
    for _ in range(2):
        u, v, du, dv = at(memory.pieces, 0.0)
        first = ((grip[0] - u) * du + (grip[1] - v) * dv) / (du * du + dv * dv)
        length = _equal_steps(memory, first, last)
        usable, clear = _measure(picture, fit, memory.samples, length, memory.scratch)
        if not usable > _MIN_DETECTED * clear:
            return Traced(_NO_CABLE, 0.0, 0.0, 0.0, 0.0)
        fit_cable(memory.samples, memory.pieces, memory.equations)
        last = 1.0
    misfit = _misfit(memory.samples, memory.pieces)
    signal = _median_used(memory, STRENGTH)
    noise = _median_used(memory, _NOISE)
    return Traced(SEEN, contrast, usable / clear, misfit, signal / max(noise, 0.1))


@inline
def _misfit(samples, pieces):  # type: ignore[no-untyped-def]
    """Root mean square distance of the measured points from the curve, px."""
    squares, count = 0.0, 0
    for n in range(SAMPLES):
        if samples[n, WEIGHT] > 0.0:
            u, v, _, _ = at(pieces, samples[n, PARAMETER])
            off = (samples[n, COLUMN] - u) * samples[n, _NORMAL_U]
            off += (samples[n, ROW] - v) * samples[n, _NORMAL_V]
            squares += off * off
            count += 1
    return sqrt(squares / count)


@inline
def _median_used(memory, column):  # type: ignore[no-untyped-def]
    """Median of a column of the samples that were used."""
    count = 0
    for n in range(SAMPLES):
        if memory.samples[n, WEIGHT] > 0.0:
            memory.scratch[0, count] = memory.samples[n, column]
            count += 1
    return median(memory.scratch, count)


@part
def _equal_steps(memory, first, last):  # type: ignore[no-untyped-def]
    """Points and normals at equal arc length, into `samples`; returns the length from grip to tip.

    first, last  parameters of the curve at the gripping point and at the tip
    """
    s, samples = memory.scratch[0], memory.samples
    before_u, before_v, _, _ = at(memory.pieces, first)
    s[0] = 0.0
    step = (last - first) / (_FINE - 1)
    for k in range(1, _FINE):
        u, v, _, _ = at(memory.pieces, first + k * step)
        s[k] = s[k - 1] + hypot(u - before_u, v - before_v)
        before_u, before_v = u, v
    length = s[_FINE - 1]
    k = 0
    for n in range(SAMPLES):
        place = n / (SAMPLES - 1) * length
        while k < _FINE - 2 and s[k + 1] < place:
            k += 1
        share = (place - s[k]) / (s[k + 1] - s[k])
        u, v, du, dv = at(memory.pieces, first + (k + share) * step)
        norm = hypot(du, dv)
        samples[n, _AT_U], samples[n, _AT_V] = u, v
        samples[n, _NORMAL_U], samples[n, _NORMAL_V] = -dv / norm, du / norm
    return length


@part
def _measure(picture, fit, samples, length, scratch):  # type: ignore[no-untyped-def]
    """Measure offsets across the curve at the samples, and the points for the next fit.

    returns  numbers of usable samples, and of samples clear of jaw and tip
    """
    usable, clear = 0, 0
    for n in range(SAMPLES):
        u, v = samples[n, _AT_U], samples[n, _AT_V]
        nu, nv = samples[n, _NORMAL_U], samples[n, _NORMAL_V]
        offset, amplitude, noise = offset_at(picture, u, v, nu, nv, fit, scratch)
        place = n / (SAMPLES - 1)
        away = place * length
        inside = away > _START_PX and length - away > _END_PX
        clear += inside
        good = inside and np.isfinite(offset)
        usable += good
        if not good:
            offset = 0.0
        samples[n, COLUMN], samples[n, ROW] = u + offset * nu, v + offset * nv
        samples[n, STRENGTH], samples[n, _NOISE] = amplitude, noise
        samples[n, PARAMETER], samples[n, WEIGHT] = place, 1.0 if good else 0.0
    return usable, clear


@part
def median(scratch, count):  # type: ignore[no-untyped-def]
    """Median of the first values of row 0, by Hoare's selection, which sorts the row partly."""
    rank, low, high = count // 2, 0, count - 1
    while low < high:
        pivot = scratch[0, rank]
        i, j = low, high
        while i <= j:
            while scratch[0, i] < pivot:
                i += 1
            while pivot < scratch[0, j]:
                j -= 1
            if i <= j:
                scratch[0, i], scratch[0, j] = scratch[0, j], scratch[0, i]
                i += 1
                j -= 1
        if j < rank:
            low = i
        if rank < i:
            high = j
    upper = scratch[0, rank]
    if count % 2:
        return upper
    lower = scratch[0, 0]
    for n in range(rank):
        lower = max(lower, scratch[0, n])
    return 0.5 * (lower + upper)
