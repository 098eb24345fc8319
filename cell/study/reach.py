"""How far from the gripping point markers are, and how far effects of the library can show them.

A cable is no longer than its arc length, so no marker is farther away than that.  Effects show it
farther, in three ways:

    scale    camera_scale and grip_slip enlarge all distances along the cable alike.  This shows
             between neighbouring markers, too, without the gripper.
    offset   camera_roll and camera_scale move what is away from the picture's centre: all markers
             near the gripper alike.
    delay    camera_latency and robot_lag: in the meantime the gripper has moved.

Each limit is the bound within which a fit varies that effect.  What is beyond all of them is an
error of the files.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.data import Trial

#: Largest factor of camera_scale, and largest length by which grip_slip frees the cable, m.
LARGEST_SCALE, LARGEST_SLIP_M = 2.0, 0.05
#: Offset of the gripper's picture, free lengths: camera_roll by its bound of 0.5 rad about a centre
#: one free length away, or camera_scale by its bound about a centre half as far.
LARGEST_OFFSET = 0.5
#: Longest delay of camera_latency and robot_lag, s, and at how many times the gripper is looked up.
LARGEST_DELAY_S, _LOOKS = 0.1, 9


@dataclass(frozen=True, eq=False)
class Reach:
    """Distances of a trial's markers from the gripping point, and what effects make of them.

    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    length_m      free length of the cable
    """

    trial: Trial
    arc_length_m: FloatArray
    length_m: float

    @cached_property
    def distance_m(self) -> FloatArray:
        """(T, markers) from the gripping point, less the gripper's way within a delay.

        A coordinate that was not seen adds nothing: the result is the least that it can be.
        """
        markers = self.trial.markers
        away_m = np.nan_to_num(markers.xy_m - self.trial.gripper_m(markers.t_s)[:, None])
        return np.asarray(np.linalg.norm(away_m, axis=2) - self._delay_way_m[:, None])

    @cached_property
    def _delay_way_m(self) -> FloatArray:
        """(T,) longest way of the gripper within a delay before or after a frame."""
        now_m = self.trial.gripper_m(self.trial.markers.t_s)
        return np.asarray(np.max(np.linalg.norm(self.delayed_m - now_m, axis=2), axis=0))

    @cached_property
    def delayed_m(self) -> FloatArray:
        """(delays, T, 2) gripping point when the pictures were taken, for every delay."""
        t_s, delays_s = self.trial.markers.t_s, np.linspace(-1.0, 1.0, _LOOKS) * LARGEST_DELAY_S
        return np.array([self.trial.gripper_m(t_s - delay_s) for delay_s in delays_s])

    @cached_property
    def scale(self) -> float:
        """Factor by which the cable between neighbouring markers seems longer than stated.

        At least 1, at most that of an effect; the most of an effect where no two are seen at once.
        """
        most = max(LARGEST_SCALE, 1.0 + LARGEST_SLIP_M / self.length_m)
        order = np.argsort(self.arc_length_m)
        between_m = np.diff(self.arc_length_m[order])
        apart_m = np.linalg.norm(np.diff(self.trial.markers.xy_m[:, order], axis=1), axis=2)
        seen = np.isfinite(apart_m).any(axis=0) & (between_m > 0.0)
        if not seen.any():
            return most
        ratios = np.nanmedian(apart_m[:, seen], axis=0) / between_m[seen]
        return float(np.clip(np.median(ratios), 1.0, most))

    @property
    def limit_m(self) -> float:
        """Distance that no marker can have."""
        return (self.scale + LARGEST_OFFSET) * self.length_m

    @property
    def limits_m(self) -> FloatArray:
        """(markers,) distance that each cannot have, by its arc length."""
        return self.scale * self.arc_length_m + LARGEST_OFFSET * self.length_m

    @cached_property
    def _whole_m(self) -> FloatArray:
        """(T, markers) distances where both coordinates were seen, else nan."""
        shown = np.isfinite(self.trial.markers.xy_m).all(axis=2)
        return np.where(shown, self.distance_m, np.nan)

    @cached_property
    def usual_m(self) -> FloatArray:
        """(markers,) median distance; nan of a marker that is never seen."""
        usual_m = np.full(self._whole_m.shape[1], np.nan)
        seen = np.isfinite(self._whole_m).any(axis=0)
        usual_m[seen] = np.nanmedian(self._whole_m[:, seen], axis=0)
        return usual_m

    def beyond(self, limits_m: FloatArray) -> tuple[int, int] | None:
        """The marker whose median is farthest beyond its limit (markers,), and since which row.

        None if there is no such marker.
        """
        excess_m = np.nan_to_num(self.usual_m - limits_m, nan=-np.inf)
        marker = int(np.argmax(excess_m))
        if excess_m[marker] <= 0.0:
            return None
        each_m = self._whole_m[::-1, marker]
        far = each_m > limits_m[marker]
        # From the first row on that half of the rows after it agree with: noise may be far once.
        rows = np.maximum(np.cumsum(np.isfinite(each_m)), 1)
        return marker, int(np.argmax((far & (np.cumsum(far) > 0.5 * rows))[::-1]))
