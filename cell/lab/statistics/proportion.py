"""The interval of a probability, by how often something has happened."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri as normal_quantile


def wilson(hits: int, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of a probability after `hits` of `count`; all of 0 … 1 where nothing was tried.

    source  Wilson 1927, J. Am. Stat. Assoc. 22, 209
    """
    if not 0 <= hits <= count:
        raise ValueError(f"{hits} of {count}: must be between none and all")
    if count == 0:
        return 0.0, 1.0
    z = float(normal_quantile(0.5 + 0.5 * confidence))
    share, spread = hits / count, z * z / count
    middle = share + 0.5 * spread
    half = float(np.sqrt(spread * (share * (1.0 - share) + 0.25 * spread)))
    low, high = (middle - half) / (1.0 + spread), (middle + half) / (1.0 + spread)
    return max(0.0, low), min(1.0, high)
