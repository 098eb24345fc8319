"""Measurement noise of markers: its standard deviation and its autocorrelation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.cable.geometry import Motion, moves_from_s

#: Fewest still frames of a trial from which noise is estimated.
FEWEST_STILL_FRAMES = 8

_LARGEST_AR1 = 0.98


@dataclass(frozen=True)
class Noise:
    """Error of one coordinate of one marker: autocorrelated, and constant within a trial.

    std_m        standard deviation in one frame, m
    ar1          correlation between neighbouring frames (AR(1) coefficient), 0 … <1
    white        share of the variance that is white noise, 0 … <1: of rounded values, for example
    bias_m       standard deviation of an error that is constant throughout a trial, m
    across_only  markers show the position across the cable only, not along it: nodes placed at
                 equal arc lengths on a detected line
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
        """Independent values per value, when averaging: (1 − ρ) / (1 + ρ) for AR(1) noise."""
        slow = (1.0 + self.ar1) / (1.0 - self.ar1)
        return 1.0 / (self.white + (1.0 - self.white) * slow)


def rms(residual_m: FloatArray) -> float:
    """Root mean square of the finite values; nan if there are none."""
    finite = residual_m[np.isfinite(residual_m)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def still_frames(t_s: FloatArray, grip: Motion, release_s: float | None = None) -> slice:
    """Frames before anything moves: the gripper, or a cable held straight until `release_s`."""
    until = moves_from_s(grip) - 0.01
    if release_s is not None:
        until = min(until, release_s)
    return slice(0, int(np.searchsorted(t_s, until)))


def estimate_noise(still: Sequence[FloatArray]) -> tuple[float, float] | None:
    """Standard deviation and autocorrelation of the noise from frames in which nothing moves.

    still    per trial (T, markers, coordinates), m; nan where not observed
    returns  standard deviation [m] and AR(1) coefficient, pooled over all markers and coordinates;
             None if no marker of any trial was observed in `FEWEST_STILL_FRAMES`
    source   moments of lag 0 and 1 about the sample mean, corrected for its variance
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
    ar1 = float(np.clip(raw, 0.0, _LARGEST_AR1))
    for _ in range(50):
        of_mean, before = _variance_of_mean(ar1, length), ar1
        ar1 = min(max(raw * (1.0 - of_mean) + of_mean, 0.0), _LARGEST_AR1)
        if ar1 == before:
            break
    return float(np.sqrt(variance / (1.0 - _variance_of_mean(ar1, length)))), ar1


def _variance_of_mean(ar1: float, frames: float) -> float:
    """Variance of the mean of an AR(1) series of unit variance."""
    # 1 + 2 Σ (1 − k / frames) ar1ᵏ over k = 1 … last, by the sums of a geometric series
    last = max(1, round(frames) - 1)
    power, rest = ar1**last, 1.0 - ar1
    sum_of_powers = ar1 * (1.0 - power) / rest
    sum_of_lags = ar1 * (1.0 - (last + 1) * power + last * ar1 * power) / rest**2
    return (1.0 + 2.0 * (sum_of_powers - sum_of_lags / frames)) / frames


def across(markers_m: FloatArray) -> FloatArray:
    """(T, markers, 2) unit normals of the cable at the markers, from neighbours in the frame.

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
