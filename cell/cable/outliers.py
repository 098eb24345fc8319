"""Outliers of a logged signal: detected against its noise, and replaced by interpolation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.compiling import compiled, inline

#: A value of the log that lies apart by more standard deviations of its noise than this is wrong;
#: it is compared with so many neighbours on either side.
GLITCH, _BESIDE = 4.5, 3
#: More of them in a row are none: the curve turns sharply there, and is smoothed too much.
ADJACENT = 3
#: Values that a line at an end goes along.
_ON_LINE = 4
#: A single value is wrong, however little noise there is, if with it made up from those beside it
#: no more is left than this share of the fourth differences' squares around it (of a corner in the
#: curve 4.7 % would be), and if it lies apart by more than this, m or rad, and so many standard
#: deviations of the noise: a smoothing follows these.
_ROUGH, _LEAST_APART, _ALONE = 0.03, 1e-5, 12.0
#: Fourth differences looked at for single wrong values: the largest of the log.
_MOST_WRONG = 50


def wrong_alone(t: FloatArray, y: FloatArray, noise: float) -> tuple[int, ...]:
    """Indices of single outliers, the largest first, also if the other values are exact.

    A smoothing that follows the noise closely follows a wrong value too.
    """
    found: tuple[int, ...] = ()
    mended, rough = y, fourth_differences(t, y)
    size, looked = np.abs(rough), np.zeros(len(rough), dtype=bool)
    for _ in range(_MOST_WRONG):
        i = int(np.argmax(np.where(looked, 0.0, size)))
        number = _alone(t, rough, i, noise)
        if number < 0 or number in found or _as_ends_are(t, y, number, noise):
            looked[i] = True
            continue
        found = (*found, number)
        mended = made_up(t, y, found)
        rough = fourth_differences(t, mended)
        size = np.abs(rough)
    return found


def _as_ends_are(t: FloatArray, y: FloatArray, number: int, noise: float) -> bool:
    """Whether a value is the first or last, and rests or goes on as those next to it do.

    Fourth differences cannot tell a sharp start from a wrong first value.
    """
    if 0 < number < t.size - 1:
        return False
    apart = _from_end(t, y, number, np.arange(t.size), 1 if number == 0 else -1)
    return abs(apart) <= max(_LEAST_APART, _ALONE * noise)


@compiled
def _alone(t: FloatArray, rough: FloatArray, i: int, noise: float) -> int:
    """The value among those of fourth difference i that is wrong, if one alone is; else −1."""
    least, best = np.inf, -1
    for number in range(i, i + 5):
        first, end = max(0, number - 6), min(t.size, number + 7)
        unit = np.zeros(end - first)
        unit[number - first] = 1.0
        shape, seen = _fourth_differences(t[first:end], unit), rough[first : end - 4]
        square, along, total = 0.0, 0.0, 0.0
        for k in range(shape.size):
            square += shape[k] * shape[k]
            along += shape[k] * seen[k]
            total += seen[k] * seen[k]
        size, apart = math.sqrt(square), along / square
        left = 0.0
        for k in range(shape.size):
            left += (seen[k] - apart * shape[k]) ** 2
        most = _ROUGH * total
        sure = abs(apart) > max(_LEAST_APART, _ALONE * noise, GLITCH * noise / size)
        at_end = size < 0.2  # first or last: no corner can be told from it, nor its neighbour
        if at_end and sure and left < max(most, 4.0 * seen.size * noise**2):
            return number
        if sure and left < min(most, least):
            least, best = left, number
    return best


def made_up(t: FloatArray, y: FloatArray, wrong: Sequence[int]) -> FloatArray:
    """The values with outliers interpolated: by cubics in between, by lines at the ends."""
    if not wrong:
        return y
    good = np.setdiff1d(np.arange(len(t)), wrong)
    y = y.copy()
    for i in wrong:
        y[i] -= _interpolation_at(good, i)(t, y, i, good)
    return y


def bridged(t: FloatArray, y: FloatArray, wrong: NDArray[np.bool_]) -> FloatArray:
    """(T,) values with outliers interpolated linearly, and extrapolated at the ends.

    t  (T,) s; y (T,) m or rad; wrong (T,)
    """
    good, out = np.flatnonzero(~wrong), y.copy()
    out[wrong] = np.interp(t[wrong], t[good], y[good])
    for i in np.flatnonzero(wrong):
        if not good[0] < i < good[-1]:
            out[i] = y[i] - _interpolation_at(good, int(i))(t, y, int(i), good)
    return out


def _interpolation_at(good: NDArray[np.intp], i: int) -> Callable[..., float]:
    """What value i is compared with: a cubic through good values, or what an end may be like."""
    place = int(np.searchsorted(good, i))
    inward = 1 if place < 2 else -1 if place > len(good) - 2 else 0
    return partial(_from_end, inward=inward) if inward else _from_cubic


def glitches(residual: FloatArray, noise: float) -> NDArray[np.bool_]:
    """Flags of values that differ from the local median by more than noise; one or two in a row.

    Where a curve is smoothed too much its neighbours lie beside it as well.
    """
    around = np.pad(residual, _BESIDE, mode="reflect")
    middle = np.median(np.lib.stride_tricks.sliding_window_view(around, 2 * _BESIDE + 1), axis=1)
    return np.asarray(np.abs(residual - middle) > GLITCH * noise)


def off_curve(
    t: FloatArray,
    y: FloatArray,
    suspected: NDArray[np.bool_],
    wrong: NDArray[np.bool_],
    noise: float,
) -> NDArray[np.bool_]:
    """Flags of suspected values that lie farther from their neighbours' curve than these do.

    Where rows are few for a motion, every value lies beside the curve through those around it.  At
    an end that is a line: a cubic would make eight times as much of the noise.
    """
    good = np.flatnonzero(~(suspected | wrong))
    found = np.zeros_like(suspected)
    for i in np.flatnonzero(suspected):
        first = int(np.clip(np.searchsorted(good, i) - _BESIDE, 0, max(0, len(good) - 2 * _BESIDE)))
        near, told = good[first : first + 2 * _BESIDE], _interpolation_at(good, int(i))
        others = [abs(told(t, y, int(j), good)) for j in near]
        rough = float(np.median(others)) if others else 0.0
        found[i] = abs(told(t, y, int(i), good)) > GLITCH * max(noise, rough)
    return found


def _from_end(t: FloatArray, y: FloatArray, i: int, good: NDArray[np.intp], inward: int) -> float:
    """By how much a value at an end lies beside the least-squares line of the four good ones next.

    Where these turn, from a rest of few rows into motion say, they lie on no line.  There the next
    value counts if it rests: if it differs from the one after it by less than they do from a line.

    inward  1 = those after it, −1 = those before
    returns  m or rad, as `y`; 0 where there are fewer than four
    """
    beside = good[good > i][:_ON_LINE] if inward > 0 else good[good < i][::-1][:_ON_LINE]
    if len(beside) < _ON_LINE:
        return 0.0
    apart, values = t[beside] - t[beside].mean(), y[beside] - y[beside].mean()
    slope = float(apart @ values / (apart @ apart))
    turning = math.sqrt(float(np.sum((values - slope * apart) ** 2)) / (_ON_LINE - 2))
    moving = float(y[i] - y[beside].mean() - slope * (t[i] - t[beside].mean()))
    resting = float(y[i] - y[beside[0]])
    rests = abs(y[beside[0]] - y[beside[1]]) < turning
    return resting if rests and abs(resting) < abs(moving) else moving


def _from_cubic(t: FloatArray, y: FloatArray, i: int, good: NDArray[np.intp]) -> float:
    """By how much a value lies beside the cubic through two good values on either side of it."""
    others = good[good != i]
    place = int(np.clip(np.searchsorted(others, i), 2, max(2, len(others) - 2)))
    beside = others[place - 2 : place + 2]
    total = 0.0
    for a in beside:
        rest = [b for b in beside if b != a]
        total += y[a] * float(np.prod([(t[i] - t[b]) / (t[a] - t[b]) for b in rest]))
    return float(y[i] - total)


def longest_run(wrong: NDArray[np.bool_]) -> int:
    """Length of the longest run of true flags."""
    edges = np.flatnonzero(np.diff(np.pad(wrong.astype(np.int8), 1)))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


@compiled
def fourth_differences(t: FloatArray, y: FloatArray) -> FloatArray:
    """(T − 4,) fourth divided differences, scaled to the variance of a single value."""
    out: FloatArray = _fourth_differences(t, y)
    return out


@inline
def _fourth_differences(t: FloatArray, y: FloatArray) -> FloatArray:
    out = np.empty(t.size - 4)
    for k in range(out.size):
        difference, square = 0.0, 0.0
        for i in range(k, k + 5):
            gaps = 1.0
            for j in range(k, k + 5):
                if j != i:
                    gaps *= t[i] - t[j]
            difference += y[i] / gaps
            square += 1.0 / (gaps * gaps)
        out[k] = difference / math.sqrt(square)
    return out
