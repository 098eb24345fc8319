"""The destination area, and by how much a tip path passes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Destination:
    """Rectangle of the cell's plane that the tip must pass: a hole open towards +x, m.

    The hole's mouth is the edge x = x_max, its floor and ceiling are y_min and y_max, and at
    x = x_min the tip is deep enough.  The tip *passes* when, from the first time it goes through
    the mouth until the first time thereafter that it is deep enough, it is between floor and
    ceiling whenever x ≤ x_max.  It may swing back out of the mouth meanwhile: there is no wall.
    """

    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float

    def __post_init__(self) -> None:
        if not (self.x_min_m < self.x_max_m and self.y_min_m < self.y_max_m):
            raise ValueError(f"destination {self}: needs x_min < x_max and y_min < y_max")

    def margin_m(self, tip_m: FloatArray) -> FloatArray:
        """Signed margin of tip paths: > 0 passes, < 0 misses by that much.

        tip_m    (…, T, 2) tip positions in order of time, T ≥ 2, m; straight between samples
        returns  (…) m: the smallest distance to floor or ceiling during the passage (negative
                 outside).  A path that stays short of the full depth has at most minus the depth
                 it lacks, one that never reaches the mouth minus its smallest distance from it.
        raises   ValueError: fewer than two samples, or samples that are not finite
        """
        if tip_m.ndim < 2 or tip_m.shape[-2:][1] != 2 or tip_m.shape[-2] < 2:
            raise ValueError(f"tip path has shape {tip_m.shape}, not (…, T ≥ 2, 2)")
        if not np.all(np.isfinite(tip_m)):
            raise ValueError("tip path has samples that are not finite: leave unseen frames out")
        x, y = tip_m[..., 0], tip_m[..., 1]
        step = np.arange(x.shape[-1] - 1)
        enters = (x[..., :-1] > self.x_max_m) & (x[..., 1:] <= self.x_max_m)
        first = np.where(enters.any(-1), enters.argmax(-1), x.shape[-1])[..., None]
        deepens = (x[..., :-1] > self.x_min_m) & (x[..., 1:] <= self.x_min_m) & (step >= first)
        reached = deepens.any(-1)
        last = np.where(reached, deepens.argmax(-1), x.shape[-1] - 1)[..., None]

        clearance = np.minimum(y - self.y_min_m, self.y_max_m - y)
        # samples within the hole, and the points where the path crosses its two ends
        sample = np.arange(x.shape[-1])
        within = (sample > first) & (sample <= last) & (x <= self.x_max_m)
        margin = np.where(within, clearance, np.inf).min(-1)
        for edge_m in (self.x_max_m, self.x_min_m):
            crosses = (x[..., :-1] > edge_m) != (x[..., 1:] > edge_m)
            crosses &= (step >= first) & (step <= last)
            with np.errstate(divide="ignore", invalid="ignore"):
                part = (edge_m - x[..., :-1]) / (x[..., 1:] - x[..., :-1])
                y_edge = y[..., :-1] + part * (y[..., 1:] - y[..., :-1])
            at_edge = np.minimum(y_edge - self.y_min_m, self.y_max_m - y_edge)
            margin = np.minimum(margin, np.where(crosses, at_edge, np.inf).min(-1))

        after_entry = np.where(sample > first, x, np.inf).min(-1)
        lacking = np.where(reached, np.inf, self.x_min_m - after_entry)
        outside = np.maximum(np.maximum(self.y_min_m - y, y - self.y_max_m), 0.0)
        distance = np.hypot(x - self.x_max_m, outside).min(-1)
        result: FloatArray = np.where(enters.any(-1), np.minimum(margin, lacking), -distance)
        return result

    def miss_m(self, tip_m: FloatArray) -> FloatArray:
        """(…) how far the tip misses the passage, m; 0 where it passes.  See `margin_m`."""
        return np.maximum(-self.margin_m(tip_m), 0.0)
