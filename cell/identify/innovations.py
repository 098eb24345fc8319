"""Whitening of series with autocorrelated errors: their innovations."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray


def frames_since(observed: NDArray[np.bool_]) -> NDArray[np.int_]:
    """(T, series) number of a series' own frames since its last observation; 0 = none before.

    Where cameras have their own clocks, the table has a row for each camera's frames, and a series
    is observed in every second row, for example.  Rows of the other camera are not counted; rows
    in which its own marker was lost are.
    observed  (T, series)
    """
    frame = np.arange(len(observed))[:, None]
    last = np.maximum.accumulate(np.where(observed, frame, -1), axis=0)
    since = np.zeros(observed.shape, dtype=np.int_)
    since[1:] = np.where(last[:-1] >= 0, frame[1:] - last[:-1], 0)
    for series in range(observed.shape[1]):
        between = np.diff(np.flatnonzero(observed[:, series]))
        usual = int(np.median(between)) if len(between) else 1
        if usual > 1:
            gap = since[:, series]
            since[:, series] = np.where(gap > 0, np.maximum(1, np.rint(gap / usual)), 0)
    return since


def innovations(
    observed: NDArray[np.bool_], std_m: float, ar1: float, white: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coefficients that whiten series with AR(1) and white noise.

    observed  (T, series)
    returns   (series, T) each: AR coefficient since the last frame; 1/std of the innovation, 1/m,
              0 if unobserved; Kalman gain: share of the innovation that enters the AR state
    """
    since = frames_since(observed)
    memory = np.where(observed & (since > 0), ar1**since, 0.0)
    gain = np.ones(observed.shape)
    variance = 1.0 - memory**2
    if white > 0.0:
        variance = innovation_variances(observed, memory, white, gain)
    weight = np.where(observed, 1.0 / (std_m * np.sqrt(variance)), 0.0)
    return tuple(np.ascontiguousarray(v.T) for v in (memory, weight, gain))  # type: ignore[return-value]


@njit(cache=True)
def innovation_variances(
    observed: NDArray[np.bool_], memory: FloatArray, white: float, gain: FloatArray
) -> FloatArray:
    """(T, series) innovation variance of AR(1) plus white noise, for a total variance of 1.

    memory  (T, series) AR coefficient since the last frame; 0 where there is none
    gain    (T, series) is filled with the Kalman gain
    source  Kalman 1960, of a scalar state
    """
    frames, series = memory.shape
    variance = np.ones((frames, series))
    for i in range(series):
        known = 0.0
        for t in range(frames):
            if observed[t, i]:
                fresh = memory[t, i] ** 2 * known + (1.0 - memory[t, i] ** 2) * (1.0 - white)
                variance[t, i] = fresh + white
                gain[t, i] = fresh / variance[t, i]
                known = (1.0 - gain[t, i]) * fresh
    return variance


@njit(cache=True)
def made_white(
    values: FloatArray,
    observed: NDArray[np.bool_],
    since: NDArray[np.int_],
    ar1: float,
    white: float,
    of_white: float,
) -> tuple[FloatArray, float]:
    """(frames, series, columns) whitened values, of the original variance; 0 where unobserved.

    since     (frames, series) frames since the last observation, 0 = none
    of_white  AR(1) coefficient of the white share
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
            if not observed[t, i]:
                continue
            memory = ar1 ** since[t, i] if since[t, i] > 0 else 0.0
            other = of_white ** since[t, i] if since[t, i] > 0 else 0.0
            # both states sum up to the observation: their errors are opposite, of variance `known`
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
    """Fill `ones` (markers, channels, T) with a whitened constant of 1 m."""
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
    """Fill `out` (lanes, markers, channels, T) with white residuals; 0 where not observed.

    axes  (T, markers, channels, 2) unit vectors of the channels
    pull  (markers, channels) share of the component along `ones` that is removed, over |ones|²
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
                    share = gain[marker, channel, t]
                    last = error if share == 1.0 else error - (1.0 - share) * new
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
