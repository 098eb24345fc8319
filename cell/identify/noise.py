"""Measurement noise of markers: its size, its colour, and residuals made white by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cell.cable.geometry import Motion
from cell.cable.still import moves_from_s

FloatArray = NDArray[np.float64]

#: Fewest still frames of a trial from which noise is estimated.
FEWEST_STILL_FRAMES = 8

#: A smooth residual changes over no fewer frames than this, and is of so many powers of the place.
SLOW_FRAMES, ALONG = 8, 3

_STRONGEST_COLOUR = 0.98


@dataclass(frozen=True)
class Noise:
    """Error of one coordinate of one marker: coloured in time, and constant within a trial.

    std_m        standard deviation in one frame, m
    ar1          correlation between neighbouring frames (AR(1) coefficient), 0 … <1
    white        share of the variance that is new in every frame beside that, 0 … <1: of values
                 that are rounded, say
    bias_m       standard deviation of what is constant throughout a trial, m
    across_only  markers tell where the cable is, not how far along it they are: nodes placed at
                 equal arc lengths on a line that was seen
    """

    std_m: float
    ar1: float = 0.0
    bias_m: float = 0.0
    across_only: bool = False
    white: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.std_m) and self.std_m > 0.0):
            raise ValueError(f"noise std is {self.std_m} m: must be finite and > 0")
        if not 0.0 <= self.ar1 < 1.0:
            raise ValueError(f"noise ar1 is {self.ar1}: must be in [0, 1)")
        if not 0.0 <= self.white < 1.0:
            raise ValueError(f"noise white is {self.white}: must be in [0, 1)")
        if not self.bias_m >= 0.0:
            raise ValueError(f"noise bias is {self.bias_m} m: must be ≥ 0")

    @property
    def effective_fraction(self) -> float:
        """Independent values per value, when averaging: (1 − ρ) / (1 + ρ) of what is coloured."""
        slow = (1.0 + self.ar1) / (1.0 - self.ar1)
        return 1.0 / (self.white + (1.0 - self.white) * slow)


def still_frames(t_s: FloatArray, grip: Motion, release_s: float | None = None) -> slice:
    """Frames before anything moves: the hand, or a cable held straight until `release_s`."""
    until = moves_from_s(grip) - 0.01
    if release_s is not None:
        until = min(until, release_s)
    return slice(0, int(np.searchsorted(t_s, until)))


def estimate_noise(still: Sequence[FloatArray]) -> tuple[float, float] | None:
    """Size and colour of the noise from frames in which nothing moves.

    still    per trial (T, markers, coordinates), m; nan where not seen
    returns  standard deviation [m] and AR(1) coefficient, pooled over all markers and coordinates;
             None if no marker of any trial was seen in `FEWEST_STILL_FRAMES`
    source   moments of lag 0 and 1 about the sample mean, whose own variance is allowed for
    """
    square = product = squares = products = channel_count = 0.0
    for markers in still:
        if len(markers) < FEWEST_STILL_FRAMES:
            continue
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
        of_mean, before = _variance_of_mean(colour, length), colour
        colour = min(max(raw * (1.0 - of_mean) + of_mean, 0.0), _STRONGEST_COLOUR)
        if colour == before:
            break
    return float(np.sqrt(variance / (1.0 - _variance_of_mean(colour, length)))), colour


def _variance_of_mean(colour: float, frames: float) -> float:
    """Variance of the mean of an AR(1) series of unit variance."""
    # 1 + 2 Σ (1 − k / frames) colourᵏ over k = 1 … last, by the sums of a geometric series
    last = max(1, round(frames) - 1)
    power, rest = colour**last, 1.0 - colour
    sum_of_powers = colour * (1.0 - power) / rest
    sum_of_lags = colour * (1.0 - (last + 1) * power + last * colour * power) / rest**2
    return (1.0 + 2.0 * (sum_of_powers - sum_of_lags / frames)) / frames


def across(markers_m: FloatArray) -> FloatArray:
    """(T, markers, 2) unit vectors across the cable, from the neighbours seen in the frame.

    Where there are none, that of the marker's last frame that has some, else upwards.
    """
    frames, markers, _ = markers_m.shape
    along = np.gradient(markers_m, axis=1) if markers > 1 else np.full_like(markers_m, np.nan)
    length = np.linalg.norm(along, axis=-1)
    known = np.isfinite(length) & (length > 0.0)
    along = np.where(known[..., None], along / np.where(known, length, 1.0)[..., None], [1.0, 0.0])
    last = np.maximum.accumulate(np.where(known, np.arange(frames)[:, None], 0), axis=0)
    along = along[last, np.arange(markers)]
    return np.stack([-along[..., 1], along[..., 0]], axis=-1)


class Whitener:
    """Turns predicted markers of one trial into white residuals of unit size.

    A channel (x or y of a marker, or its place across the cable) has an AR(1) error over the
    frames in which it was seen, a white one beside it (then its innovations are those of a Kalman
    filter), plus a constant of known variance, which is integrated out.

    seen  (T, markers, channels) whether a channel was seen: a marker may show one coordinate only
    """

    def __init__(self, markers_m: FloatArray, noise: Noise) -> None:
        """`markers_m` (T, markers, 2) as measured, nan where not seen."""
        self.noise = noise
        finite = np.isfinite(markers_m)
        self.frames, markers = finite.shape[:2]
        if noise.across_only:
            self._axes = np.ascontiguousarray(across(markers_m)[:, :, None])
            self.seen = np.asarray(finite.all(axis=-1, keepdims=True), dtype=np.bool_)
            measured = self.seen
        else:
            self._axes = np.broadcast_to(np.eye(2), (self.frames, markers, 2, 2)).copy()
            self.seen = measured = finite
        self.measured = np.where(measured, markers_m, 0.0)
        self.channels = self._axes.shape[2]
        self.rows = markers * self.channels * self.frames
        self.count = int(self.seen.sum())
        series = self.seen.reshape(self.frames, -1)
        self._memory, self._weight, self._gain = (
            v.reshape(markers, self.channels, self.frames) for v in _innovations(series, noise)
        )
        # what a constant looks like when white, and which part of a residual along it is taken out
        self._ones = self._weight.copy()
        if noise.white > 0.0:
            _whiten_constant(self._memory, self._weight, self._gain, self._ones)
        else:
            self._ones[..., 1:] *= 1.0 - self._memory[..., 1:]
        size = np.sum(self._ones**2, axis=-1)
        self._kept = 1.0 / np.sqrt(1.0 + noise.bias_m**2 * size)
        self._size = np.where(size > 0.0, size, 1.0)

    def __call__(self, predicted_m: FloatArray) -> FloatArray:
        """White residuals (measured − predicted).

        predicted_m  (lanes, T, markers, 2), m
        returns      (lanes, rows) ordered marker, channel, frame; 0 where not seen
        """
        out = np.empty((len(predicted_m), *self._memory.shape))
        pull = (1.0 - self._kept) / self._size
        _whiten(
            predicted_m,
            self.measured,
            self._axes,
            self._memory,
            self._weight,
            self._gain,
            self._ones,
            pull,
            out,
        )
        return out.reshape(len(predicted_m), self.rows)

    @cached_property
    def smooth_modes(self) -> tuple[FloatArray, ...]:
        """Per channel (markers × frames, modes) orthonormal smooth functions of what was seen.

        Cosines in time and polynomials along the cable span them.  A misfit of a model is there, of
        noise only a few per cent.
        """
        return tuple(_smooth_modes(self.seen[..., c]) for c in range(self.channels))

    def error_m(self, white: FloatArray) -> FloatArray:
        """(T, markers, channels) errors behind white residuals (rows,), m; nan if unseen."""
        fresh = white.reshape(self._memory.shape)
        along = np.sum(fresh * self._ones, axis=-1)
        back = (1.0 / self._kept - 1.0) / self._size
        fresh = fresh + (back * along)[..., None] * self._ones
        error = np.full(self.seen.shape, np.nan)
        _colour(np.ascontiguousarray(fresh), self._memory, self._weight, self._gain, error)
        return error


def _smooth_modes(seen: NDArray[np.bool_]) -> FloatArray:
    """(markers × frames, modes) of what was seen (frames, markers) in a channel."""
    frames, markers = seen.shape
    slow = max(2, frames // SLOW_FRAMES)
    in_time = np.cos(np.pi * np.outer(np.arange(frames) + 0.5, np.arange(slow)) / frames)
    along = np.vander(np.linspace(-1.0, 1.0, markers), min(markers, ALONG))
    functions = np.einsum("mk,tj->mtkj", along, in_time).reshape(markers * frames, -1)
    functions = functions * seen.T.reshape(-1, 1)
    values, vectors = np.linalg.eigh(functions.T @ functions)
    good = values > 1e-9 * max(values[-1], 1e-300)
    return np.asarray(functions @ (vectors[:, good] / np.sqrt(values[good])))


def _innovations(
    seen: NDArray[np.bool_], noise: Noise
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(series, T) memory of the last frame's error, and 1/std of what is new, 1/m; 0 if unseen.

    And the share of what is new that the next frames remember.
    seen  (T, series)
    """
    frame = np.arange(len(seen))[:, None]
    last_seen = np.maximum.accumulate(np.where(seen, frame, -1), axis=0)
    gap = frame[1:] - last_seen[:-1]
    memory = np.zeros(seen.shape)
    memory[1:] = np.where(seen[1:] & (last_seen[:-1] >= 0), noise.ar1**gap, 0.0)
    gain = np.ones(seen.shape)
    if noise.white > 0.0:
        variance = innovation_variances(seen, memory, noise.white, gain)
    else:
        variance = 1.0 - memory**2
    weight = np.where(seen, 1.0 / (noise.std_m * np.sqrt(variance)), 0.0)
    return tuple(np.ascontiguousarray(v.T) for v in (memory, weight, gain))  # type: ignore[return-value]


@njit(cache=True)
def innovation_variances(
    seen: NDArray[np.bool_], memory: FloatArray, white: float, gain: FloatArray
) -> FloatArray:
    """(T, series) variance of what is new, of AR(1) noise and a white share that are 1 together.

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
def _whiten_constant(
    memory: FloatArray, weight: FloatArray, gain: FloatArray, ones: FloatArray
) -> None:
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
def _whiten(
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
def _colour(
    fresh: FloatArray, memory: FloatArray, weight: FloatArray, gain: FloatArray, error: FloatArray
) -> None:
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
