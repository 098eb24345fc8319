"""The tip's measured passage through the destination, and the error of its forecast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.plan.destination import Destination

#: Most consecutive frames without the tip while it passes, for the passage to count as measured.
MOST_UNSEEN = 3


@dataclass(frozen=True)
class Passage:
    """The tip's passage as measured; nan = not known.

    margin_m      see `Destination.margin_m`
    miss_m        height of the tip above the middle of the opening, when it goes through it
    error_m       largest distance between measured and predicted tip while it is in the
                  destination's range of x
    reason        why it does not count as passed; None if it passed
    """

    margin_m: float
    miss_m: float
    error_m: float
    reason: str | None

    @property
    def passed(self) -> bool:
        """Whether the measured tip passed."""
        return self.reason is None


def height_at_opening_m(destination: Destination, tip_m: FloatArray) -> float:
    """Height of a tip path (T, 2) above the opening's middle, m; nan if it never goes through."""
    x, y = tip_m[:, 0], tip_m[:, 1]
    through = (x[:-1] > destination.x_max_m) & (x[1:] <= destination.x_max_m)
    if not through.any():
        return float("nan")
    i = int(np.argmax(through))
    share = (destination.x_max_m - x[i]) / (x[i + 1] - x[i])
    middle_m = 0.5 * (destination.y_min_m + destination.y_max_m)
    return float(y[i] + share * (y[i + 1] - y[i]) - middle_m)


def path_at(t_s: FloatArray, path_t_s: FloatArray, path_m: FloatArray) -> FloatArray:
    """(T, 2) places on a path (P, 2), m, at times (T,); straight between its samples."""
    return np.column_stack([np.interp(t_s, path_t_s, axis) for axis in path_m.T])


def measured_passage(
    destination: Destination,
    t_s: FloatArray,
    tip_m: FloatArray,
    predicted_t_s: FloatArray,
    predicted_tip_m: FloatArray,
) -> Passage:
    """Compare a measured tip path with the destination and with its forecast.

    t_s, tip_m    (T,), (T, 2) from the pictures, nan where unseen
    predicted_…   (P,), (P, 2) on the same clock
    """
    detected = np.isfinite(tip_m).all(axis=1)
    nothing = float("nan")
    if detected.sum() < 2:
        return Passage(nothing, nothing, nothing, "the tip was not seen during the execution")
    t, tip = t_s[detected], tip_m[detected]
    margin_m = float(destination.margin_m(tip))
    miss_m = height_at_opening_m(destination, tip)
    predicted = path_at(t, predicted_t_s, predicted_tip_m)
    inside = (tip[:, 0] <= destination.x_max_m) & (tip[:, 0] >= destination.x_min_m)
    # A tip that leaps over the destination between two frames is judged by the nearest of them.
    inside[np.argmin(np.abs(tip[:, 0] - destination.x_max_m))] = True
    error_m = float(np.linalg.norm(tip - predicted, axis=1)[inside].max())

    reason = None
    if margin_m <= 0.0:
        reason = f"the tip missed the destination by {-margin_m * 1e3:.2f} mm"
    else:
        x = tip[:, 0]
        before = int(np.argmax((x[:-1] > destination.x_max_m) & (x[1:] <= destination.x_max_m)))
        deep = before + int(np.argmax(x[before:] <= destination.x_min_m))
        period_s = float(np.median(np.diff(t_s)))
        longest = round(float(np.diff(t[before : deep + 1]).max()) / period_s) - 1
        if longest > MOST_UNSEEN:
            reason = f"the tip was not seen in {longest} frames while it passed"
    return Passage(margin_m, miss_m, error_m, reason)
