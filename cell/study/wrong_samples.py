"""Single samples of markers that are no motion: a tracker's slip, a digit lost in a table.

A sample is compared with what those around it foretell, and judged by what is left of these
themselves, so that a fast motion seen by a slow camera is as rough for its neighbours as for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Numbers = NDArray[np.intp]

#: Samples on either side with which one is compared: few where the motion is fast for the camera,
#: many where there is noise to be averaged.
BESIDE = (4, 6, 10)
#: What is left of the others is that of a cubic in time.
_TERMS = 4
#: A sample is wrong if it lies apart by more standard deviations than these, of what such a
#: difference has by chance: given what is left of the others here, and in this share of the record.
#: Of 1.6 million right samples none did, in a study of the design of tools/wrong_sample_study.py.
HERE, ELSEWHERE, SHARE = 6.0, 5.5, 0.75
#: Of several near each other each hides the others.  Those farthest apart may be left out of the
#: comparison, so many; what is left is less by choice then, and the limit has to be higher.
OTHERS, AMONG_OTHERS = 2, 15.0
#: Below this nothing is left of anything, m: the rounding of computed positions.
_NOTHING_M = 1e-8
#: Values rounded to steps have errors of at least a step by √12, though they seem to be at rest.
#: The step is this quantile of the differences between values: a wrong one may stand off all steps.
_OF_STEPS, _STEP_STD = 0.05, 12.0**-0.5
#: A value of which a curve leaves free less than this share is as good as given by it.
_FREE = 1e-3
_MOST_ROUNDS = 50


@dataclass(frozen=True)
class _Comparison:
    """Of every sample (rows,) of every channel: how it compares with those around it.

    apart_m  by how much it lies apart from the curve through the others
    std      standard deviation of that, for values of unit noise
    left_m   what is left of the others beside the curve
    """

    apart_m: FloatArray
    std: FloatArray
    left_m: FloatArray

    def times(self, noise_m: FloatArray | float) -> FloatArray:
        """Standard deviations of noise by which samples lie apart."""
        return np.abs(self.apart_m) / (self.std * np.maximum(noise_m, _NOTHING_M))


def wrong_samples(t_s: FloatArray, series_m: FloatArray) -> FloatArray:
    """By how much samples that are wrong lie apart from their curve, m; nan where one is right.

    t_s       (T,)
    series_m  (T, channels) coordinates, or what a model leaves of them; nan = not seen

    Of what smoothness tells: what is slower than a few samples, or less than some five times the
    noise or the roughness of the motion itself, is left in.
    """
    left, wrong = series_m.copy(), np.full_like(series_m, np.nan)
    least_m = _STEP_STD * np.array([_step_m(values) for values in series_m.T])
    for _ in range(_MOST_ROUNDS):
        found = np.full_like(left, np.nan)
        for beside in BESIDE:
            _look(t_s, left, least_m, (beside, 0), found)
        if np.isnan(found).all():
            _look(t_s, left, least_m, (BESIDE[-1], OTHERS), found)
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


def _look(
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
    beside, others = look
    here, elsewhere = (HERE, ELSEWHERE) if others == 0 else (AMONG_OTHERS, AMONG_OTHERS)
    compared = [
        (rows, channel, comparison)
        for rows, channels in _seen_alike(series_m)
        if len(rows) > 2 * beside + 1
        for channel, comparison in _compared(t_s, series_m, rows, channels, beside, others)
    ]
    usual_m = [float(np.quantile(c.left_m, SHARE)) for _, _, c in compared]
    # The same camera sees all: a marker that hardly moves shows less than its noise, if rounded.
    of_all_m = float(np.median(usual_m)) if usual_m else 0.0
    for (rows, channel, c), noise_m in zip(compared, usual_m, strict=True):
        times = c.times(np.maximum(c.left_m, least_m[channel]))
        # One that is wrong makes those beside it seem to be: the worst goes first.
        around = np.lib.stride_tricks.sliding_window_view(np.pad(times, beside), 2 * beside + 1)
        far = (times > here) & (times == np.max(around, axis=1))
        far &= c.times(max(noise_m, of_all_m, least_m[channel])) > elsewhere
        out[rows[far], channel] = c.apart_m[far]


def _seen_alike(series_m: FloatArray) -> Iterator[tuple[Numbers, list[int]]]:
    """Rows, and the channels that are seen in exactly these."""
    seen = np.isfinite(series_m)
    alike: dict[bytes, list[int]] = {}
    for channel in range(series_m.shape[1]):
        alike.setdefault(seen[:, channel].tobytes(), []).append(channel)
    for channels in alike.values():
        yield np.flatnonzero(seen[:, channels[0]]), channels


def _compared(
    t_s: FloatArray,
    series_m: FloatArray,
    rows: Numbers,
    channels: list[int],
    beside: int,
    others: int,
) -> Iterator[tuple[int, _Comparison]]:
    """Every sample of channels seen in the same rows with as many around it, before and after."""
    width, count = 2 * beside + 1, len(rows)
    first = np.clip(np.arange(count) - beside, 0, count - width)
    around = rows[first[:, None] + np.arange(width)]
    own = np.arange(count) - first
    apart_s = t_s[around] - t_s[rows][:, None]
    scaled = apart_s / np.max(np.abs(apart_s), axis=1, keepdims=True)
    curve = np.linalg.qr(scaled[:, :, None] ** np.arange(_TERMS))[0]
    for channel in channels:
        values = series_m[:, channel]
        y = values[around] - values[rows][:, None]
        yield channel, _beside_curve(curve, y, own, others)


def _beside_curve(basis: FloatArray, y: FloatArray, own: Numbers, others: int) -> _Comparison:
    """Samples beside curves fitted to those around them, without the `others` farthest from these.

    basis  (rows, width, terms) orthonormal columns of the curves around every sample
    y      (rows, width) around every sample
    own    (rows,) where in `y` the sample itself is
    """
    each = np.arange(len(y))
    with_own = _freed(basis, own) if others else basis
    for _ in range(others):
        rest_m, free = _rest(with_own, y)
        farthest = np.argmax(
            np.where(free > _FREE, rest_m**2 / np.maximum(free, _FREE), 0.0), axis=1
        )
        basis, with_own = _freed(basis, farthest), _freed(with_own, farthest)
    rest_m, free = _rest(basis, y)
    alone = np.maximum(free[each, own], _FREE**2)
    apart_m = rest_m[each, own] / alone
    square = np.sum(rest_m**2, axis=1) - rest_m[each, own] * apart_m
    freedom = y.shape[1] - basis.shape[2] - 1
    left_m = np.sqrt(np.maximum(square, 0.0) / freedom)
    return _Comparison(apart_m, 1.0 / np.sqrt(alone), left_m)


def _rest(basis: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(rows, width) what a fit leaves of the values, and which part of each it does not follow."""
    along = np.einsum("twk,tw->tk", basis, y)
    rest_m = y - np.einsum("twk,tk->tw", basis, along)
    return rest_m, 1.0 - np.sum(basis**2, axis=2)


def _freed(basis: FloatArray, number: Numbers) -> FloatArray:
    """The basis with one value of every row (rows,) of its own, so that it counts no more."""
    spike = np.zeros(basis.shape[:2])
    spike[np.arange(len(basis)), number] = 1.0
    for _ in range(2):  # once more against rounding
        spike -= np.einsum("twk,tk->tw", basis, np.einsum("twk,tw->tk", basis, spike))
    length = np.linalg.norm(spike, axis=1, keepdims=True)
    spike = np.where(length > _FREE, spike / np.maximum(length, _FREE), 0.0)
    return np.concatenate([basis, spike[:, :, None]], axis=2)
