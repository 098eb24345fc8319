"""Statistics of positions over time: span, noise, runs of true values, interpolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray


def span_m(xy_m: FloatArray, cut: float = 0.0) -> float:
    """Span of positions (T, d) over the detected coordinates; nan if there are none.

    cut  share of the smallest and of the largest values that are ignored, for single wrong ones
    """
    good = xy_m[:, np.isfinite(xy_m).any(axis=0)]
    if not good.size:
        return float("nan")
    low, high = np.nanquantile(good, [cut, 1.0 - cut], axis=0)
    return float(np.linalg.norm(high - low))


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of each run of true values (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def forward_filled(values: FloatArray, detected: NDArray[np.bool_]) -> FloatArray:
    """Values (T, …) with missing ones, by `detected` (T, channels), as last detected."""
    rows = np.where(detected, np.arange(len(detected))[:, None], 0)
    last = np.maximum.accumulate(rows, axis=0)
    return np.array(values[last, np.arange(detected.shape[1])])


def rounding_step_m(values_m: FloatArray) -> float:
    """Smallest difference of two values (…): their step, if they are rounded; 0 = all are equal."""
    steps = np.diff(np.unique(values_m[np.isfinite(values_m)]))
    return float(np.min(steps)) if steps.size else 0.0


def first_lasting(flags: NDArray[np.bool_], count: int) -> int | None:
    """Index of the first of `count` successive true values (T,); None = there are none.

    The last value is assumed to continue.
    """
    ahead = np.concatenate([flags, np.repeat(flags[-1:], count - 1)])
    lasts = np.lib.stride_tricks.sliding_window_view(ahead, count).all(axis=1)
    return int(np.argmax(lasts)) if lasts.any() else None


def interpolated(at_s: FloatArray, t_s: FloatArray, values: FloatArray) -> FloatArray:
    """(at, d) linear interpolation of the detected values (T, d) at times; nan = none is."""
    between = np.full((len(at_s), values.shape[1]), np.nan)
    for channel, series in enumerate(values.T):
        detected = np.isfinite(series)
        if detected.any():
            between[:, channel] = np.interp(at_s, t_s[detected], series[detected])
    return between


def by_missing_pattern(detected: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Indices of channels of `detected` (T, channels), grouped by equal patterns of rows."""
    alike: dict[bytes, list[int]] = {}
    for channel, rows in enumerate(detected.T):
        alike.setdefault(rows.tobytes(), []).append(channel)
    return [np.array(channels) for channels in alike.values()]


def noise_m(still_m: FloatArray) -> float:
    """Noise of one coordinate in one frame (T, …) at rest, by second differences; nan = too few.

    Slow errors do not contribute.
    """
    bends = np.abs(np.diff(still_m, 2, axis=0)) / np.sqrt(6.0)
    if len(bends) < 3 or not np.isfinite(bends).any():
        return float("nan")
    return 1.4826 * float(np.nanmedian(bends))


def wrapped(angle_rad: float) -> float:
    """The angle, wrapped to −π … π."""
    return float((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)
