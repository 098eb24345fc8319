"""Outliers of single samples: a tracker's slip, or a digit lost in a table.

A sample is compared with its prediction from its neighbours.  The limit follows from the residuals
of the neighbours themselves, which a fast motion before a slow camera raises equally.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray
from cell.study.series import by_missing_pattern

Numbers = NDArray[np.intp]

#: Samples on either side with which one is compared: few where the motion is fast for the camera,
#: many where there is noise to be averaged.
HALF_WIDTHS = (4, 6, 10)
#: What is left of the others is that of a cubic in time.
_TERMS = 4
#: A sample is wrong if it lies apart by more standard deviations than these, of what such a
#: difference has by chance: given what is left of the others here, and in this share of the record.
#: Of 1.6 million right samples of simulated swings none did.
LOCAL_SIGMAS, RECORD_SIGMAS, RECORD_QUANTILE = 6.0, 5.5, 0.75
#: Of several near each other each hides the others.  Those farthest apart may be left out of the
#: comparison, so many; what is left is less by choice then, and the limit has to be higher.
OMITTED, SIGMAS_IF_OMITTED = 2, 15.0
#: Below this nothing is left of anything, m: the rounding of computed positions.
_NOTHING_M = 1e-8
#: Values rounded to steps have errors of at least a step by √12, though they seem to be at rest.
#: The step is this quantile of the differences between values: a wrong one may stand off all steps.
_OF_STEPS, _STEP_STD = 0.05, 12.0**-0.5
#: A value of which a curve leaves free less than this share is as good as given by it.
_FREE = 1e-3
_MOST_ROUNDS = 50
#: Values around samples that are looked at together: more are no faster, and take memory.
_AT_ONCE = 150_000


@dataclass(frozen=True)
class _Comparison:
    """Of every sample (rows, channels) of some channels: how it compares with those around it.

    rows      (rows,) of the series
    channels  of the series
    distance_m   by how much it lies apart from the curve through the others
    std       standard deviation of that, for values of unit noise
    residual_m    what is left of the others beside the curve
    usual_m   (channels,) what is left in the record as a whole
    """

    rows: Numbers
    channels: Numbers
    distance_m: FloatArray
    std: FloatArray
    residual_m: FloatArray
    usual_m: FloatArray

    def times(self, noise_m: FloatArray) -> FloatArray:
        """Standard deviations of noise by which samples lie apart."""
        return np.abs(self.distance_m) / (self.std * np.maximum(noise_m, _NOTHING_M))


def outlier_distances(t_s: FloatArray, series_m: FloatArray) -> FloatArray:
    """Distance of each outlier from the curve through its neighbours, m; nan for all other samples.

    t_s       (T,)
    series_m  (T, channels) coordinates, or what a model leaves of them; nan = not seen

    Of what smoothness tells: what is slower than a few samples, or less than some five times the
    noise or the roughness of the motion itself, is left in.
    """
    left, wrong = series_m.copy(), np.full_like(series_m, np.nan)
    least_m = _STEP_STD * np.array([_step_m(values) for values in series_m.T])
    for _ in range(_MOST_ROUNDS):
        found = np.full_like(left, np.nan)
        for half_width in HALF_WIDTHS:
            _enter_outliers(t_s, left, least_m, (half_width, 0), found)
        if np.isnan(found).all():
            _enter_outliers(t_s, left, least_m, (HALF_WIDTHS[-1], OMITTED), found)
        there = np.isfinite(found)
        if not there.any():
            break
        wrong[there], left[there] = found[there], np.nan
    return wrong


def _step_m(values_m: FloatArray) -> float:
    """Between what values of a table are rounded to, m, or less."""
    seen = values_m[np.isfinite(values_m)]
    between = np.diff(np.unique(np.round(seen, 9)))
    return float(np.quantile(between, _OF_STEPS)) if len(between) else 0.0


def _enter_outliers(
    t_s: FloatArray,
    series_m: FloatArray,
    least_m: FloatArray,
    look: tuple[int, int],
    out: FloatArray,
) -> None:
    """Enter what is wrong by one comparison into `out` (T, channels).

    least_m  (channels,) noise that there is at least
    look     how many are beside a sample, and how many others may be left out
    """
    half_width, omitted = look
    local, record = (SIGMAS_IF_OMITTED,) * 2 if omitted else (LOCAL_SIGMAS, RECORD_SIGMAS)
    seen = np.isfinite(series_m)
    compared = [
        comparison
        for channels in by_missing_pattern(seen)
        if len(rows := np.flatnonzero(seen[:, channels[0]])) > 2 * half_width + 1
        for comparison in _compared(t_s, series_m, rows, channels, half_width, omitted)
    ]
    usual_m = [c.usual_m for c in compared]
    # The same camera sees all: a marker that hardly moves shows less than its noise, if rounded.
    of_all_m = float(np.median(np.concatenate(usual_m))) if usual_m else 0.0
    for c in compared:
        times = c.times(np.maximum(c.residual_m, least_m[c.channels]))
        # One that is wrong makes those beside it seem to be: the worst goes first.
        padded = np.pad(times, ((half_width, half_width), (0, 0)))
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * half_width + 1, axis=0)
        far = (times > local) & (times == np.max(around, axis=2))
        noise_m = np.maximum(np.maximum(c.usual_m, of_all_m), least_m[c.channels])
        far &= c.times(noise_m) > record
        row, channel = np.nonzero(far)
        out[c.rows[row], c.channels[channel]] = c.distance_m[far]


def _compared(
    t_s: FloatArray,
    series_m: FloatArray,
    rows: Numbers,
    channels: Numbers,
    half_width: int,
    omitted: int,
) -> Iterator[_Comparison]:
    """Every sample of channels seen in the same rows with as many around it, before and after."""
    width, count = 2 * half_width + 1, len(rows)
    first = np.clip(np.arange(count) - half_width, 0, count - width)
    around = rows[first[:, None] + np.arange(width)]
    own = np.arange(count) - first
    offset_s = t_s[around] - t_s[rows][:, None]
    scaled = offset_s / np.max(np.abs(offset_s), axis=1, keepdims=True)
    curve = np.linalg.qr(scaled[:, :, None] ** np.arange(_TERMS))[0]
    at_once = max(1, _AT_ONCE // around.size)
    for part in np.split(channels, range(at_once, len(channels), at_once)):
        seen_m = series_m[rows[:, None], part]
        y = np.take(seen_m, first[:, None] + np.arange(width), axis=0)
        y -= seen_m[:, None]
        distance_m, std, residual_m = _residuals_of_curve(curve, y, own, omitted)
        usual_m = np.quantile(residual_m, RECORD_QUANTILE, axis=0)
        yield _Comparison(rows, part, distance_m, std, residual_m, usual_m)


def _residuals_of_curve(
    curve: FloatArray, y: FloatArray, own: Numbers, others: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Samples beside curves fitted to those around them, without the `others` farthest from these.

    curve    (rows, width, terms) orthonormal columns of the curves around every sample
    y        (rows, width, channels) around every sample
    own      (rows,) where in `y` the sample itself is
    returns  (rows, channels) each: distance_m, std and residual_m of `_Comparison`
    """
    each, beside = np.arange(len(y)), _Fit.of(curve, y)
    without_own = beside.without(own[:, None]) if others else beside
    for more in range(others - 1, -1, -1):
        share = without_own.residual_m**2 / np.maximum(without_own.free, _FREE)
        share[np.broadcast_to(without_own.free <= _FREE, share.shape)] = 0.0
        farthest = np.argmax(share, axis=1)
        beside = beside.without(farthest)
        without_own = without_own.without(farthest) if more else without_own
    alone = np.maximum(beside.free[each, own], _FREE**2)
    distance_m = beside.residual_m[each, own] / alone
    square = np.sum(beside.residual_m**2, axis=1) - beside.residual_m[each, own] * distance_m
    freedom = y.shape[1] - curve.shape[2] - others - 1
    residual_m = np.sqrt(np.maximum(square, 0.0) / freedom)
    return distance_m, 1.0 / np.sqrt(np.broadcast_to(alone, residual_m.shape)), residual_m


@dataclass(frozen=True)
class _Fit:
    """What curves leave of the values around samples, some values of which may be left out.

    curve     (rows, width, terms)
    residual_m  (rows, width, channels)
    free      (rows, width, channels or 1) which part of each value the curve does not follow
    omitted   (rows, width, channels or 1) of each value that is left out: a direction that the
              curve may follow besides, of length 1
    """

    curve: FloatArray
    residual_m: FloatArray
    free: FloatArray
    omitted: tuple[FloatArray, ...] = ()

    @staticmethod
    def of(curve: FloatArray, y: FloatArray) -> _Fit:
        """Of all values."""
        residual_m = y - curve @ (curve.transpose(0, 2, 1) @ y)
        return _Fit(curve, residual_m, 1.0 - np.sum(curve**2, axis=2)[:, :, None])

    def without(self, number: Numbers) -> _Fit:
        """Without one value more, which one (rows, channels), or (rows, 1) of all channels."""
        each, one = np.arange(len(number))[:, None], number[:, None, :]
        here = self.curve[each, number]  # (rows, channels, terms)
        spike = self.curve @ here.transpose(0, 2, 1)
        np.negative(spike, out=spike)
        np.put_along_axis(spike, one, np.take_along_axis(spike, one, 1) + 1.0, 1)
        for former in self.omitted:
            spike = spike - former * np.take_along_axis(former, one, 1)
        length = np.sqrt(np.maximum(np.take_along_axis(spike, one, 1), 0.0))
        spike *= np.where(length > _FREE, 1.0 / np.maximum(length, _FREE), 0.0)
        own_m = np.take_along_axis(self.residual_m, one, 1) / np.maximum(length, _FREE)
        free = self.free - spike**2
        return _Fit(self.curve, self.residual_m - spike * own_m, free, (*self.omitted, spike))
