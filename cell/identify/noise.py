"""Measurement noise of markers: its size, its colour, and residuals made white by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cell.cable.geometry import Motion
from cell.identify.hand import moves_from_s

FloatArray = NDArray[np.float64]

#: Fewest still frames of a trial from which noise is estimated.
FEWEST_STILL_FRAMES = 8

_STRONGEST_COLOUR = 0.98


@dataclass(frozen=True)
class Noise:
    """Error of one coordinate of one marker: coloured in time, and constant within a trial.

    std_m       standard deviation in one frame, m
    colour      correlation between neighbouring frames (AR(1) coefficient), 0 … <1
    bias_across_m, bias_along_m   standard deviation of what is constant throughout a trial, across
                the cable and along it, m: what a tracer of a line's middle does at its end
    """

    std_m: float
    colour: float = 0.0
    bias_across_m: float = 0.0
    bias_along_m: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.std_m) and self.std_m > 0.0):
            raise ValueError(f"noise std is {self.std_m} m: must be finite and > 0")
        if not 0.0 <= self.colour < 1.0:
            raise ValueError(f"noise colour is {self.colour}: must be in [0, 1)")
        if min(self.bias_across_m, self.bias_along_m) < 0.0:
            raise ValueError("noise bias must be ≥ 0")


def still_frames(t_s: FloatArray, grip: Motion, release_s: float | None = None) -> slice:
    """Frames before anything moves: the hand, or a cable held straight until `release_s`."""
    until = moves_from_s(grip) - 0.01
    if release_s is not None:
        until = min(until, release_s)
    return slice(0, int(np.searchsorted(t_s, until)))


def estimate_noise(still: Sequence[FloatArray]) -> tuple[float, float] | None:
    """Size and colour of the noise from frames in which nothing moves.

    still    per trial (T, markers, 2) markers, m; nan where not seen
    returns  standard deviation [m] and AR(1) coefficient, pooled over all markers and coordinates;
             None if no marker of any trial was seen in `FEWEST_STILL_FRAMES`
    source   moments of lag 0 and 1 about the sample mean, whose own variance is allowed for
    """
    square = product = squares = products = channel_count = 0.0
    for markers in still:
        channels = markers.reshape(len(markers), -1)
        channels = channels[:, np.isfinite(channels).sum(0) >= FEWEST_STILL_FRAMES]
        if channels.shape[1] == 0:
            continue
        channel_count += channels.shape[1]
        error = channels - np.nanmean(channels, axis=0)
        neighbours = error[1:] * error[:-1]
        square += float(np.nansum(error**2))
        product += float(np.nansum(neighbours))
        squares += float(np.isfinite(error).sum())
        products += float(np.isfinite(neighbours).sum())
    if squares == 0.0:
        return None
    length = squares / channel_count
    variance = square / squares
    if variance == 0.0 or products == 0.0:
        return float(np.sqrt(variance)), 0.0
    raw = product / products / variance
    colour = float(np.clip(raw, 0.0, _STRONGEST_COLOUR))
    for _ in range(50):
        of_mean = _variance_of_mean(colour, length)
        colour = float(np.clip(raw * (1.0 - of_mean) + of_mean, 0.0, _STRONGEST_COLOUR))
    return float(np.sqrt(variance / (1.0 - _variance_of_mean(colour, length)))), colour


def _variance_of_mean(colour: float, frames: float) -> float:
    """Variance of the mean of an AR(1) series of unit variance."""
    lags = np.arange(1, max(2, round(frames)))
    return float((1.0 + 2.0 * np.sum((1.0 - lags / frames) * colour**lags)) / frames)


class Whitener:
    """Turns predicted markers of one trial into white residuals of unit size.

    Each marker has two channels: x and y, or across and along the cable if the noise has a bias.
    A channel's error is AR(1) over the frames in which the marker was seen, plus a constant of
    known variance, which is integrated out.
    """

    def __init__(self, markers_m: FloatArray, noise: Noise) -> None:
        """`markers_m` (T, markers, 2) as measured, nan where not seen."""
        self.noise = noise
        self.measured = np.ascontiguousarray(markers_m, dtype=np.float64)
        self.seen = np.isfinite(self.measured).all(-1)
        frames, markers = self.seen.shape
        self.axes = np.broadcast_to(np.eye(2), (frames, markers, 2, 2)).copy()
        biases = (noise.bias_across_m, noise.bias_along_m)
        if max(biases) > 0.0:
            self.axes = _across_and_along(self.measured)
        self.measured = np.where(self.seen[..., None], self.measured, 0.0)
        self.rows = frames * markers * 2
        self.count = int(self.seen.sum()) * 2
        # what a constant error of 1 looks like once it is made white, and how much of it to take out
        ones = np.zeros((1, markers, 2, frames))
        identity = np.broadcast_to(np.eye(2), self.axes.shape).copy()
        still = np.zeros((1, frames, markers, 2))
        nothing = np.zeros((markers, 2))
        one = np.ones((frames, markers, 2))
        self._memory, self._weight = _innovations(self.seen, noise)
        memory, innovation = self._memory, self._weight
        _whiten(still, one, identity, memory, innovation, ones[0].copy(), nothing, ones)
        self._ones = ones[0]
        weight = np.sum(self._ones**2, axis=-1)
        taken = 1.0 - 1.0 / np.sqrt(1.0 + np.square(biases) * weight)
        self._shrink = taken / np.where(weight > 0.0, weight, 1.0)

    def __call__(self, predicted_m: FloatArray) -> FloatArray:
        """White residuals (measured − predicted).

        predicted_m  (lanes, T, markers, 2), m
        returns      (lanes, rows); unit variance; 0 where a marker was not seen
        """
        lanes = len(predicted_m)
        markers, _, frames = self._ones.shape
        out = np.empty((lanes, markers, 2, frames))
        _whiten(
            predicted_m,
            self.measured,
            self.axes,
            self._memory,
            self._weight,
            self._ones,
            self._shrink,
            out,
        )
        return out.reshape(lanes, self.rows)


def _across_and_along(markers_m: FloatArray) -> FloatArray:
    """(T, markers, 2, 2) unit vectors across and along the cable, from the neighbours seen."""
    along = np.gradient(markers_m, axis=1) if markers_m.shape[1] > 1 else markers_m * np.nan
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    along = np.where(np.isfinite(length) & (length > 0.0), along / length, [1.0, 0.0])
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    return np.ascontiguousarray(np.stack([across, along], axis=-2))


def _innovations(seen: NDArray[np.bool_], noise: Noise) -> tuple[FloatArray, FloatArray]:
    """(markers, T) memory of the last frame's error, and 1/std of what is new, 1/m; 0 if unseen."""
    frame = np.arange(len(seen))[:, None]
    last_seen = np.maximum.accumulate(np.where(seen, frame, -1), axis=0)
    gap = frame[1:] - last_seen[:-1]
    memory = np.zeros(seen.shape)
    memory[1:] = np.where(seen[1:] & (last_seen[:-1] >= 0), noise.colour**gap, 0.0)
    weight = np.where(seen, 1.0 / (noise.std_m * np.sqrt(1.0 - memory**2)), 0.0)
    return np.ascontiguousarray(memory.T), np.ascontiguousarray(weight.T)


@njit(cache=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _whiten(
    predicted: FloatArray,
    measured: FloatArray,
    axes: FloatArray,
    memory: FloatArray,
    weight: FloatArray,
    ones: FloatArray,
    shrink: FloatArray,
    out: FloatArray,
) -> None:
    lanes, frames, markers, _ = predicted.shape
    for lane in range(lanes):
        for marker in range(markers):
            for channel in range(2):
                last_error = 0.0
                along_ones = 0.0
                row = out[lane, marker, channel]
                for t in range(frames):
                    if weight[marker, t] == 0.0:
                        row[t] = 0.0
                        continue
                    dx = measured[t, marker, 0] - predicted[lane, t, marker, 0]
                    dy = measured[t, marker, 1] - predicted[lane, t, marker, 1]
                    error = axes[t, marker, channel, 0] * dx + axes[t, marker, channel, 1] * dy
                    row[t] = (error - memory[marker, t] * last_error) * weight[marker, t]
                    along_ones += row[t] * ones[marker, channel, t]
                    last_error = error
                pull = shrink[marker, channel] * along_ones
                if pull != 0.0:
                    for t in range(frames):
                        row[t] -= pull * ones[marker, channel, t]
