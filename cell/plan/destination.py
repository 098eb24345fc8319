"""The destination area, and the margin by which a tip path passes it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from cell.cable.arrays import FloatArray


@dataclass(frozen=True)
class Destination:
    """Rectangle of the cell's plane that the tip must pass: an opening towards +x, m.

    The opening is the edge x = x_max, its floor and ceiling are y_min and y_max, and at
    x = x_min the tip is deep enough.  The tip *passes* when, from the first time it goes through
    the opening until the first time thereafter that it is deep enough, it is between floor and
    ceiling whenever x ≤ x_max.  It may swing back out of the opening meanwhile: there is no wall.
    """

    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float

    def __post_init__(self) -> None:
        if not (self.x_min_m < self.x_max_m and self.y_min_m < self.y_max_m):
            raise ValueError(f"destination {self}: needs x_min < x_max and y_min < y_max")

    @property
    def corners_m(self) -> FloatArray:
        """(4, 2) corners, in order around the rectangle."""
        low, high = self.y_min_m, self.y_max_m
        return np.array(
            [[self.x_min_m, high], [self.x_max_m, high], [self.x_max_m, low], [self.x_min_m, low]]
        )

    def margin_m(self, tip_m: FloatArray) -> FloatArray:
        """Signed margin of tip paths: > 0 passes, < 0 misses by that much.

        tip_m    (…, T, 2) tip positions in order of time, T ≥ 2, m; straight between samples
        returns  (…) m: the smallest distance to floor or ceiling during the passage (negative
                 outside).  A path that stays short of the full depth has at most minus the depth
                 it lacks, one that never reaches the opening minus its smallest distance from it.
        raises   ValueError: fewer than two samples, or samples that are not finite
        """
        if tip_m.ndim < 2 or tip_m.shape[-2:][1] != 2 or tip_m.shape[-2] < 2:
            raise ValueError(f"tip path has shape {tip_m.shape}, not (…, T ≥ 2, 2)")
        if not np.all(np.isfinite(tip_m)):
            raise ValueError("tip path has samples that are not finite: leave unseen frames out")
        paths = np.ascontiguousarray(tip_m, dtype=np.float64).reshape(-1, *tip_m.shape[-2:])
        box = (self.x_min_m, self.x_max_m, self.y_min_m, self.y_max_m)
        margins: FloatArray = _margins(paths, *box)
        return margins.reshape(tip_m.shape[:-2])


@njit(cache=True)
def _margins(
    paths: FloatArray, x_min: float, x_max: float, y_min: float, y_max: float
) -> FloatArray:
    """(paths,) signed margins of (paths, T, 2)."""
    result = np.empty(len(paths))
    for p in range(len(paths)):
        path = paths[p]
        first = 1  # sample behind the opening
        while first < len(path) and not (path[first - 1, 0] > x_max >= path[first, 0]):
            first += 1
        if first == len(path):
            square = np.inf
            for x, y in path:
                outside = max(y_min - y, y - y_max, 0.0)
                square = min(square, (x - x_max) ** 2 + outside**2)
            result[p] = -math.sqrt(square)
            continue
        deep = False
        margin, furthest = np.inf, x_max
        for t in range(first, len(path)):
            x, y = path[t]
            x_last, y_last = path[t - 1]
            if (x_last > x_max) != (x > x_max):
                y_edge = y_last + (x_max - x_last) / (x - x_last) * (y - y_last)
                margin = min(margin, y_edge - y_min, y_max - y_edge)
            if x_last > x_min >= x:
                y_edge = y_last + (x_min - x_last) / (x - x_last) * (y - y_last)
                margin = min(margin, y_edge - y_min, y_max - y_edge)
                deep = True
                break
            if x <= x_max:
                margin = min(margin, y - y_min, y_max - y)
                furthest = min(furthest, x)
        result[p] = margin if deep else min(margin, x_min - furthest)
    return result
