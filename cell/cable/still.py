"""When a hand counts as still: the one definition that fits, the lab and plausibility share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.geometry import Motion


@dataclass(frozen=True)
class StillWithin:
    """Distance within which a hand is still from where it began: m along either axis, and rad."""

    position_m: float
    angle_rad: float

    def by_axis(self) -> dict[str, float]:
        """The limit of every axis of a `Motion`, by its name."""
        return {"x_m": self.position_m, "y_m": self.position_m, "angle_rad": self.angle_rad}


#: A hand this close to where it began has not moved yet: above the noise and vibration of an arm
#: that is held, below what swings a cable visibly.
STILL = StillWithin(1e-4, 2e-3)
#: The same for measurements of unknown origin, whose log may be far noisier.
ROUGHLY_STILL = StillWithin(1e-3, 0.01)


#: Samples of a log in a row that a hand must be away: one or two are a glitch of the log.
AWAY_SAMPLES = 3


def moves_from_s(motion: Motion, still: StillWithin = STILL) -> float:
    """Time at which the hand first leaves where it began, s; `inf` if it never does.

    Samples of the log that are wrong by more than the limit, `AWAY_SAMPLES` − 1 of them in a row
    at most, are no motion.
    """
    first = slice(0, max(1, min(10, len(motion.t_s) // 10)))
    away = np.zeros(len(motion.t_s), dtype=bool)
    for name, limit in still.by_axis().items():
        value = getattr(motion, name)
        away |= np.abs(value - np.median(value[first])) > limit
    ahead = np.concatenate([away, np.repeat(away[-1:], AWAY_SAMPLES - 1)])
    stays = np.lib.stride_tricks.sliding_window_view(ahead, AWAY_SAMPLES).all(axis=1)
    return float(motion.t_s[stays.argmax()]) if stays.any() else float("inf")
