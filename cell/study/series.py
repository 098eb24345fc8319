"""Statistics of places over time: how far they span, how noisy they are, where they stay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cell.cable.arrays import FloatArray


def span_m(xy_m: FloatArray, cut: float = 0.0) -> float:
    """How far apart places (T, d) are, along the coordinates that are seen; nan = none is.

    cut  share of the smallest and of the largest values that do not count: single wrong ones
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


def forward_filled(values: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
    """Values (T, …), each that is not seen (T, channels) as it was last; as it is before that."""
    rows = np.where(seen, np.arange(len(seen))[:, None], 0)
    last = np.maximum.accumulate(rows, axis=0)
    return np.array(values[last, np.arange(seen.shape[1])])


def rounding_step_m(values_m: FloatArray) -> float:
    """Smallest difference of two values (…): their step, if they are rounded; 0 = all are equal."""
    steps = np.diff(np.unique(values_m[np.isfinite(values_m)]))
    return float(np.min(steps)) if steps.size else 0.0
