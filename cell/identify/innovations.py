"""Series with errors that are correlated in time, made white: their innovations."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray


def frames_since(seen: NDArray[np.bool_]) -> NDArray[np.int_]:
    """(T, series) number of a series' own frames since it was last seen; 0 = not seen before.

    Where cameras have clocks of their own a table has a row for each of their frames, and a series
    is seen in every second row, say: what lies between two of its frames was none of its own.  A
    row that was lost was one.
    seen  (T, series)
    """
    frame = np.arange(len(seen))[:, None]
    last_seen = np.maximum.accumulate(np.where(seen, frame, -1), axis=0)
    since = np.zeros(seen.shape, dtype=np.int_)
    since[1:] = np.where(last_seen[:-1] >= 0, frame[1:] - last_seen[:-1], 0)
    for series in range(seen.shape[1]):
        between = np.diff(np.flatnonzero(seen[:, series]))
        usual = int(np.median(between)) if len(between) else 1
        if usual > 1:
            apart = since[:, series]
            since[:, series] = np.where(apart > 0, np.maximum(1, np.rint(apart / usual)), 0)
    return since


def innovations(
    seen: NDArray[np.bool_], std_m: float, ar1: float, white: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(series, T) AR coefficient since the last frame, 1/std of the innovation, 1/m (0 if unseen).

    And (series, T) the share of the innovation that enters the AR state: the Kalman gain.
    seen  (T, series)
    """
    since = frames_since(seen)
    memory = np.where(seen & (since > 0), ar1**since, 0.0)
    gain = np.ones(seen.shape)
    variance = 1.0 - memory**2
    if white > 0.0:
        variance = innovation_variances(seen, memory, white, gain)
    weight = np.where(seen, 1.0 / (std_m * np.sqrt(variance)), 0.0)
    return tuple(np.ascontiguousarray(v.T) for v in (memory, weight, gain))  # type: ignore[return-value]


@njit(cache=True)
def innovation_variances(
    seen: NDArray[np.bool_], memory: FloatArray, white: float, gain: FloatArray
) -> FloatArray:
    """(T, series) innovation variance of AR(1) plus white noise, for a total variance of 1.

    memory  (T, series) of the last frame's AR(1) error: 0 where there is none
    gain    (T, series) is filled with the share of it that the next frames remember
    source  Kalman 1960, of a scalar state
    """
    frames, series = memory.shape
    variance = np.ones((frames, series))
    for i in range(series):
        known = 0.0
        for t in range(frames):
            if seen[t, i]:
                fresh = memory[t, i] ** 2 * known + (1.0 - memory[t, i] ** 2) * (1.0 - white)
                variance[t, i] = fresh + white
                gain[t, i] = fresh / variance[t, i]
                known = (1.0 - gain[t, i]) * fresh
    return variance


@njit(cache=True)
def made_white(
    values: FloatArray,
    seen: NDArray[np.bool_],
    since: NDArray[np.int_],
    ar1: float,
    white: float,
    of_white: float,
) -> tuple[FloatArray, float]:
    """(frames, series, columns) whitened values, scaled to the original variance; 0 where not seen.

    since     (frames, series) from the last one seen, 0 = none
    of_white  AR(1) correlation of the white share
    returns   and ln of the determinant, of one column
    """
    frames, series, columns = values.shape
    out = np.zeros(values.shape)
    slow, rest = np.empty(columns), np.empty(columns)
    log_det = 0.0
    for i in range(series):
        known = 0.0
        slow[:], rest[:] = 0.0, 0.0
        for t in range(frames):
            if not seen[t, i]:
                continue
            memory = ar1 ** since[t, i] if since[t, i] > 0 else 0.0
            other = of_white ** since[t, i] if since[t, i] > 0 else 0.0
            # both sum up to what was seen, so that their errors are opposite, and `known` of both
            fresh = memory**2 * known + (1.0 - memory**2) * (1.0 - white)
            both = fresh - memory * other * known
            variance = both - memory * other * known + other**2 * (known - white) + white
            gain, scale = both / variance, 1.0 / np.sqrt(variance)
            known = fresh - gain * both
            log_det += np.log(variance)
            for c in range(columns):
                new = values[t, i, c] - memory * slow[c] - other * rest[c]
                out[t, i, c] = new * scale
                slow[c] = memory * slow[c] + gain * new
                rest[c] = values[t, i, c] - slow[c]
    return out, log_det


@njit(cache=True)
def whiten_constant(
    memory: FloatArray, weight: FloatArray, gain: FloatArray, ones: FloatArray
) -> None:
    """Fill `ones` (markers, channels, T) with what a constant of 1 m looks like when white."""
    markers, channels, frames = memory.shape
    for marker in range(markers):
        for channel in range(channels):
            last = 0.0
            for t in range(frames):
                if weight[marker, channel, t] > 0.0:
                    expected = memory[marker, channel, t] * last
                    ones[marker, channel, t] = (1.0 - expected) * weight[marker, channel, t]
                    last = expected + gain[marker, channel, t] * (1.0 - expected)


@njit(cache=True, fastmath={"contract", "nsz"}, error_model="numpy")
def whiten(
    predicted: FloatArray,
    measured: FloatArray,
    axes: FloatArray,
    memory: FloatArray,
    weight: FloatArray,
    gain: FloatArray,
    ones: FloatArray,
    pull: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (lanes, markers, channels, T) with white residuals; 0 where not seen.

    axes  (T, markers, channels, 2) unit vectors of the channels
    pull  (markers, channels) share of what is along `ones` that is taken out, by their square
    """
    lanes, markers, channels, frames = out.shape
    for lane in range(lanes):
        for marker in range(markers):
            for channel in range(channels):
                row = out[lane, marker, channel]
                fresh = weight[marker, channel]
                last = 0.0
                along = 0.0
                for t in range(frames):
                    if fresh[t] == 0.0:
                        row[t] = 0.0
                        continue
                    dx = measured[t, marker, 0] - predicted[lane, t, marker, 0]
                    dy = measured[t, marker, 1] - predicted[lane, t, marker, 1]
                    error = axes[t, marker, channel, 0] * dx + axes[t, marker, channel, 1] * dy
                    new = error - memory[marker, channel, t] * last
                    row[t] = new * fresh[t]
                    along += row[t] * ones[marker, channel, t]
                    kept = gain[marker, channel, t]
                    last = error if kept == 1.0 else error - (1.0 - kept) * new
                along *= pull[marker, channel]
                if along != 0.0:
                    for t in range(frames):
                        row[t] -= along * ones[marker, channel, t]


@njit(cache=True)
def coloured(
    fresh: FloatArray, memory: FloatArray, weight: FloatArray, gain: FloatArray, error: FloatArray
) -> None:
    """Fill `error` (T, markers, channels), m, with the errors of these innovations; nan stays."""
    markers, channels, frames = fresh.shape
    for marker in range(markers):
        for channel in range(channels):
            last = 0.0
            for t in range(frames):
                if weight[marker, channel, t] > 0.0:
                    new = fresh[marker, channel, t] / weight[marker, channel, t]
                    last = memory[marker, channel, t] * last + new
                    error[t, marker, channel] = last
                    last -= (1.0 - gain[marker, channel, t]) * new
