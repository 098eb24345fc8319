"""Outliers of a logged signal: detected against its noise, and replaced by interpolation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.cable.compiling import compiled, inline

#: An outlier differs from its neighbours by more standard deviations of the noise than this;
#: number of neighbours on either side that a value is compared with.
GLITCH, _REACH = 4.5, 3
#: Longer runs are no outliers: the curve turns sharply there and is smoothed too much.
ADJACENT = 3
#: Values that the line through an end is fitted to.
_ON_LINE = 4
#: A single value is an outlier, also without noise, if interpolating it leaves at most this share
#: of the sum of squared fourth differences around it (at a corner of the curve 4.7 % remain), and
#: if it deviates by more than this distance, m or rad, and this many standard deviations of the
#: noise: a smoothing spline would follow such an outlier.
_ROUGH, _LEAST_APART, _ALONE = 0.03, 1e-5, 12.0
#: Number of the largest fourth differences that are examined for single outliers.
_MOST_WRONG = 50


def isolated_outliers(t: FloatArray, y: FloatArray, noise: float) -> tuple[int, ...]:
    """Indices of single outliers, the largest first, also if the other values are exact.

    A spline that follows the noise closely follows an outlier too.
    """
    outliers: tuple[int, ...] = ()
    interpolated, differences = y, fourth_differences(t, y)
    size, examined = np.abs(differences), np.zeros(len(differences), dtype=bool)
    for _ in range(_MOST_WRONG):
        i = int(np.argmax(np.where(examined, 0.0, size)))
        index = _alone(t, differences, i, noise)
        if index < 0 or index in outliers or _as_ends_are(t, y, index, noise):
            examined[i] = True
            continue
        outliers = (*outliers, index)
        interpolated = interpolate_outliers(t, y, outliers)
        differences = fourth_differences(t, interpolated)
        size = np.abs(differences)
    return outliers


def _as_ends_are(t: FloatArray, y: FloatArray, number: int, noise: float) -> bool:
    """Whether a value is the first or last, and at rest or on the line of its neighbours.

    Fourth differences cannot distinguish a sharp start from a wrong first value.
    """
    if 0 < number < t.size - 1:
        return False
    apart = _from_end(t, y, number, np.arange(t.size), 1 if number == 0 else -1)
    return abs(apart) <= max(_LEAST_APART, _ALONE * noise)


@compiled
def _alone(t: FloatArray, rough: FloatArray, i: int, noise: float) -> int:
    """Index of the single outlier among the values of fourth difference i; −1 if there is none."""
    least, best = np.inf, -1
    for index in range(i, i + 5):
        first, end = max(0, index - 6), min(t.size, index + 7)
        unit = np.zeros(end - first)
        unit[index - first] = 1.0
        shape, observed = _fourth_differences(t[first:end], unit), rough[first : end - 4]
        square, along, total = 0.0, 0.0, 0.0
        for k in range(shape.size):
            square += shape[k] * shape[k]
            along += shape[k] * observed[k]
            total += observed[k] * observed[k]
        size, apart = math.sqrt(square), along / square
        residual = 0.0
        for k in range(shape.size):
            residual += (observed[k] - apart * shape[k]) ** 2
        most = _ROUGH * total
        sure = abs(apart) > max(_LEAST_APART, _ALONE * noise, GLITCH * noise / size)
        at_end = size < 0.2  # first or last: not to be distinguished from a corner or its neighbour
        if at_end and sure and residual < max(most, 4.0 * observed.size * noise**2):
            return index
        if sure and residual < min(most, least):
            least, best = residual, index
    return best


def interpolate_outliers(t: FloatArray, y: FloatArray, wrong: Sequence[int]) -> FloatArray:
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
    """Function for the deviation of value i: from a cubic, or at an end from a line or a rest."""
    place = int(np.searchsorted(good, i))
    inward = 1 if place < 2 else -1 if place > len(good) - 2 else 0
    return partial(_from_end, inward=inward) if inward else _from_cubic


def glitches(residual: FloatArray, noise: float) -> NDArray[np.bool_]:
    """Flags of values that differ from the local median by more than noise; one or two in a row.

    Where a curve is smoothed too much, its neighbours have residuals of the same sign.
    """
    around = np.pad(residual, _REACH, mode="reflect")
    middle = np.median(np.lib.stride_tricks.sliding_window_view(around, 2 * _REACH + 1), axis=1)
    return np.asarray(np.abs(residual - middle) > GLITCH * noise)


def off_curve(
    t: FloatArray,
    y: FloatArray,
    suspected: NDArray[np.bool_],
    wrong: NDArray[np.bool_],
    noise: float,
) -> NDArray[np.bool_]:
    """Flags of suspected values that deviate from the local curve by more than neighbours do.

    Where samples are sparse, every value deviates from the curve through those around it.  At an
    end the curve is a line: a cubic would amplify the noise eight times as much.
    """
    good = np.flatnonzero(~(suspected | wrong))
    flags = np.zeros_like(suspected)
    for i in np.flatnonzero(suspected):
        first = int(np.clip(np.searchsorted(good, i) - _REACH, 0, max(0, len(good) - 2 * _REACH)))
        near, deviation = good[first : first + 2 * _REACH], _interpolation_at(good, int(i))
        deviations = [abs(deviation(t, y, int(j), good)) for j in near]
        typical = float(np.median(deviations)) if deviations else 0.0
        flags[i] = abs(deviation(t, y, int(i), good)) > GLITCH * max(noise, typical)
    return flags


def _from_end(t: FloatArray, y: FloatArray, i: int, good: NDArray[np.intp], inward: int) -> float:
    """Deviation of a value at an end from the least-squares line of the next four good values.

    A short rest followed by motion is not on a line.  If the two nearest neighbours differ by less
    than the line's misfit, the deviation from the nearest is returned where it is smaller.

    inward   1 = neighbours after it, −1 = before
    returns  m or rad, as `y`; 0 with fewer than four neighbours
    """
    neighbours = good[good > i][:_ON_LINE] if inward > 0 else good[good < i][::-1][:_ON_LINE]
    if len(neighbours) < _ON_LINE:
        return 0.0
    offset, values = t[neighbours] - t[neighbours].mean(), y[neighbours] - y[neighbours].mean()
    slope = float(offset @ values / (offset @ offset))
    turning = math.sqrt(float(np.sum((values - slope * offset) ** 2)) / (_ON_LINE - 2))
    moving = float(y[i] - y[neighbours].mean() - slope * (t[i] - t[neighbours].mean()))
    resting = float(y[i] - y[neighbours[0]])
    rests = abs(y[neighbours[0]] - y[neighbours[1]]) < turning
    return resting if rests and abs(resting) < abs(moving) else moving


def _from_cubic(t: FloatArray, y: FloatArray, i: int, good: NDArray[np.intp]) -> float:
    """Deviation of a value from the cubic through two good values on either side of it."""
    others = good[good != i]
    place = int(np.clip(np.searchsorted(others, i), 2, max(2, len(others) - 2)))
    neighbours = others[place - 2 : place + 2]
    total = 0.0
    for a in neighbours:
        rest = [b for b in neighbours if b != a]
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
