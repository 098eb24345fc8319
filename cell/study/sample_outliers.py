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

#: Numbers of neighbours on either side: few for a motion that is fast for the camera, many to
#: average noise.
HALF_WIDTHS = (4, 6, 10)
#: Terms of the curve through the neighbours: a cubic in time.
_TERMS = 4
#: Limits of an outlier's distance in standard deviations: by the residuals of its neighbours, and
#: by this quantile of the residuals of the record.  None of 1.6 million correct samples of
#: simulated swings exceeded them.
LOCAL_SIGMAS, RECORD_SIGMAS, RECORD_QUANTILE = 6.0, 5.5, 0.75
#: Neighbouring outliers mask each other, so up to this number of the largest residuals may be
#: omitted; the selection makes the remaining residuals smaller, so the limit is higher.
OMITTED, SIGMAS_IF_OMITTED = 2, 15.0
#: Least residual, m: the rounding of computed positions.
_NOTHING_M = 1e-8
#: Rounded values have errors of at least a step by √12, even if they seem to be at rest.  The step
#: is this quantile of the differences between values, because outliers may be off the steps.
_OF_STEPS, _STEP_STD = 0.05, 12.0**-0.5
#: Least share of a value's variance outside the curve's space; below it the curve determines it.
_FREE = 1e-3
_MOST_ROUNDS = 50
#: Number of values that are processed at once: more are no faster, and need memory.
_AT_ONCE = 150_000


@dataclass(frozen=True)
class _Comparison:
    """Comparison of every sample (rows, channels) of some channels with its neighbours.

    rows      (rows,) of the series
    channels  of the series
    distance_m   distance from the curve through the neighbours
    std       standard deviation of that, for values of unit noise
    residual_m    rms residual of the neighbours to the curve
    usual_m   (channels,) quantile of these residuals in the record
    """

    rows: Numbers
    channels: Numbers
    distance_m: FloatArray
    std: FloatArray
    residual_m: FloatArray
    usual_m: FloatArray

    def times(self, noise_m: FloatArray) -> FloatArray:
        """Distances of samples in standard deviations of the noise."""
        return np.abs(self.distance_m) / (self.std * np.maximum(noise_m, _NOTHING_M))


def outlier_distances(t_s: FloatArray, series_m: FloatArray) -> FloatArray:
    """Distance of each outlier from the curve through its neighbours, m; nan for all other samples.

    t_s       (T,)
    series_m  (T, channels) coordinates, or residuals of a model; nan = not detected

    Only violations of smoothness are detected: errors that are slower than a few samples, or less
    than some five times the noise or the roughness of the motion, remain.
    """
    remaining, wrong = series_m.copy(), np.full_like(series_m, np.nan)
    least_m = _STEP_STD * np.array([_step_m(values) for values in series_m.T])
    for _ in range(_MOST_ROUNDS):
        distances = np.full_like(remaining, np.nan)
        for half_width in HALF_WIDTHS:
            _enter_outliers(t_s, remaining, least_m, (half_width, 0), distances)
        if np.isnan(distances).all():
            _enter_outliers(t_s, remaining, least_m, (HALF_WIDTHS[-1], OMITTED), distances)
        there = np.isfinite(distances)
        if not there.any():
            break
        wrong[there], remaining[there] = distances[there], np.nan
    return wrong


def _step_m(values_m: FloatArray) -> float:
    """Rounding step of a table's values, m, or less."""
    detected = values_m[np.isfinite(values_m)]
    between = np.diff(np.unique(np.round(detected, 9)))
    return float(np.quantile(between, _OF_STEPS)) if len(between) else 0.0


def _enter_outliers(
    t_s: FloatArray,
    series_m: FloatArray,
    least_m: FloatArray,
    look: tuple[int, int],
    out: FloatArray,
) -> None:
    """Enter the outliers of one comparison into `out` (T, channels).

    least_m  (channels,) lower bound of the noise
    look     neighbours on either side, and number of neighbours that may be omitted
    """
    half_width, omitted = look
    local, record = (SIGMAS_IF_OMITTED,) * 2 if omitted else (LOCAL_SIGMAS, RECORD_SIGMAS)
    detected = np.isfinite(series_m)
    compared = [
        comparison
        for channels in by_missing_pattern(detected)
        if len(rows := np.flatnonzero(detected[:, channels[0]])) > 2 * half_width + 1
        for comparison in _comparisons(t_s, series_m, rows, channels, half_width, omitted)
    ]
    usual_m = [c.usual_m for c in compared]
    # One camera observes all: a marker that hardly moves shows less than its noise, if rounded.
    of_all_m = float(np.median(np.concatenate(usual_m))) if usual_m else 0.0
    for c in compared:
        times = c.times(np.maximum(c.residual_m, least_m[c.channels]))
        # An outlier affects its neighbours' comparisons: only the local maximum is entered.
        padded = np.pad(times, ((half_width, half_width), (0, 0)))
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * half_width + 1, axis=0)
        far = (times > local) & (times == np.max(around, axis=2))
        noise_m = np.maximum(np.maximum(c.usual_m, of_all_m), least_m[c.channels])
        far &= c.times(noise_m) > record
        row, channel = np.nonzero(far)
        out[c.rows[row], c.channels[channel]] = c.distance_m[far]


def _comparisons(
    t_s: FloatArray,
    series_m: FloatArray,
    rows: Numbers,
    channels: Numbers,
    half_width: int,
    omitted: int,
) -> Iterator[_Comparison]:
    """Comparisons of channels detected in the same rows, with neighbours before and after."""
    width, count = 2 * half_width + 1, len(rows)
    first = np.clip(np.arange(count) - half_width, 0, count - width)
    around = rows[first[:, None] + np.arange(width)]
    own = np.arange(count) - first
    offset_s = t_s[around] - t_s[rows][:, None]
    scaled = offset_s / np.max(np.abs(offset_s), axis=1, keepdims=True)
    curve = np.linalg.qr(scaled[:, :, None] ** np.arange(_TERMS))[0]
    at_once = max(1, _AT_ONCE // around.size)
    for part in np.split(channels, range(at_once, len(channels), at_once)):
        values_m = series_m[rows[:, None], part]
        y = np.take(values_m, first[:, None] + np.arange(width), axis=0)
        y -= values_m[:, None]
        distance_m, std, residual_m = _residuals_of_curve(curve, y, own, omitted)
        usual_m = np.quantile(residual_m, RECORD_QUANTILE, axis=0)
        yield _Comparison(rows, part, distance_m, std, residual_m, usual_m)


def _residuals_of_curve(
    curve: FloatArray, y: FloatArray, own: Numbers, others: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances of samples from curves through their neighbours, without the `others` farthest.

    curve    (rows, width, terms) orthonormal columns of the curves around every sample
    y        (rows, width, channels) around every sample
    own      (rows,) index of the sample itself in `y`
    returns  (rows, channels) each: distance_m, std and residual_m of `_Comparison`
    """
    each, fit = np.arange(len(y)), _Fit.of(curve, y)
    without_own = fit.without(own[:, None]) if others else fit
    for more in range(others - 1, -1, -1):
        share = without_own.residual_m**2 / np.maximum(without_own.free, _FREE)
        share[np.broadcast_to(without_own.free <= _FREE, share.shape)] = 0.0
        farthest = np.argmax(share, axis=1)
        fit = fit.without(farthest)
        without_own = without_own.without(farthest) if more else without_own
    alone = np.maximum(fit.free[each, own], _FREE**2)
    distance_m = fit.residual_m[each, own] / alone
    square = np.sum(fit.residual_m**2, axis=1) - fit.residual_m[each, own] * distance_m
    freedom = y.shape[1] - curve.shape[2] - others - 1
    residual_m = np.sqrt(np.maximum(square, 0.0) / freedom)
    return distance_m, 1.0 / np.sqrt(np.broadcast_to(alone, residual_m.shape)), residual_m


@dataclass(frozen=True)
class _Fit:
    """Residuals of curves through the values around samples, some of which may be omitted.

    curve     (rows, width, terms)
    residual_m  (rows, width, channels)
    free      (rows, width, channels or 1) share of each value's variance outside the curve's space
    omitted   (rows, width, channels or 1) for each omitted value: an additional direction of the
              curve's space, of length 1
    """

    curve: FloatArray
    residual_m: FloatArray
    free: FloatArray
    omitted: tuple[FloatArray, ...] = ()

    @staticmethod
    def of(curve: FloatArray, y: FloatArray) -> _Fit:
        """Fit to all values."""
        residual_m = y - curve @ (curve.transpose(0, 2, 1) @ y)
        return _Fit(curve, residual_m, 1.0 - np.sum(curve**2, axis=2)[:, :, None])

    def without(self, number: Numbers) -> _Fit:
        """Fit with a further value omitted: its index (rows, channels), or (rows, 1) for all."""
        each, index = np.arange(len(number))[:, None], number[:, None, :]
        here = self.curve[each, number]  # (rows, channels, terms)
        spike = self.curve @ here.transpose(0, 2, 1)
        np.negative(spike, out=spike)
        np.put_along_axis(spike, index, np.take_along_axis(spike, index, 1) + 1.0, 1)
        for former in self.omitted:
            spike = spike - former * np.take_along_axis(former, index, 1)
        length = np.sqrt(np.maximum(np.take_along_axis(spike, index, 1), 0.0))
        spike *= np.where(length > _FREE, 1.0 / np.maximum(length, _FREE), 0.0)
        own_m = np.take_along_axis(self.residual_m, index, 1) / np.maximum(length, _FREE)
        free = self.free - spike**2
        return _Fit(self.curve, self.residual_m - spike * own_m, free, (*self.omitted, spike))
