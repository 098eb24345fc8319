"""By how much the clock of a hand's log is off, from how its path and the cable's root move."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from cell.cable.arrays import FloatArray

#: Shifts that are tried, and samples that each is tried on.
_SHIFTS, _SAMPLES = 1500, 600
#: Both must be known at once for this share of the shorter one.
_OVERLAP = 0.5
#: A hand that moves by less than this share of what the marker moves tells no shift.
_MOVES = 0.1


def clock_shift_s(
    hand_s: FloatArray, hand_m: FloatArray, seen_s: FloatArray, seen_m: FloatArray
) -> float | None:
    """What to add to the hand's times so that a marker near it moves as it does; None = unknown.

    hand_m  (T, 2) path of the gripping point
    seen_m  (frames, 2) places of the marker nearest to it, nan = not seen
    """
    good = np.isfinite(seen_m).all(axis=1)
    seen_s, seen_m = seen_s[good], seen_m[good]
    reach = [
        float(np.linalg.norm(np.ptp(m, axis=0))) if len(m) > 3 else 0.0 for m in (hand_m, seen_m)
    ]
    if min(reach) == 0.0 or reach[0] < _MOVES * reach[1]:
        return None
    lasts_s = min(np.ptp(hand_s), np.ptp(seen_s))
    low = seen_s[0] - hand_s[-1] + _OVERLAP * lasts_s
    high = seen_s[-1] - hand_s[0] - _OVERLAP * lasts_s
    some = np.unique(np.linspace(0, len(seen_s) - 1, _SAMPLES).astype(int))
    at_s, at_m = seen_s[some], seen_m[some]

    def off(shift_s: float) -> float:
        there = (at_s >= hand_s[0] + shift_s) & (at_s <= hand_s[-1] + shift_s)
        if np.count_nonzero(there) < 4:
            return np.inf
        path = np.column_stack(
            [np.interp(at_s[there] - shift_s, hand_s, hand_m[:, k]) for k in range(2)]
        )
        return float(
            np.sum(np.var(at_m[there] - path, axis=0)) / np.sum(np.var(path, axis=0) + 1e-12)
        )

    tried = np.linspace(low, high, _SHIFTS)
    values = np.array([off(s) for s in tried])
    best = int(np.argmin(values))
    if not np.isfinite(values[best]) or values[best] > 0.5:
        return None
    step = tried[1] - tried[0]
    bounds = tried[best] - 2.0 * step, tried[best] + 2.0 * step
    return float(minimize_scalar(off, bounds=bounds, method="bounded", options={"xatol": 1e-5}).x)
