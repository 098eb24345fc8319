"""Distance of markers from the gripping point, and its limits by effects of the library.

A cable is no longer than its arc length, so no marker is farther away than that.  Effects increase
the apparent distance in three ways:

    scale    camera_scale and grip_slip enlarge all distances along the cable alike.  This shows
             between neighbouring markers, too, without the gripper.
    offset   camera_roll and camera_scale move points away from the picture's centre: all markers
             near the gripper equally.
    delay    camera_latency and robot_lag: in the meantime the gripper has moved.

Each limit is the bound within which a fit varies that effect.  Distances beyond all of them are an
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
    """Distances of a trial's markers from the gripping point, and their limits with effects.

    arc_length_m  (markers,) from the gripping point, as in `trial.markers`
    length_m      free length of the cable
    """

    trial: Trial
    arc_length_m: FloatArray
    length_m: float

    @cached_property
    def distance_m(self) -> FloatArray:
        """(T, markers) from the gripping point, minus the gripper's way within a delay.

        A missing coordinate counts as 0: the result is a lower bound.
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
        """Ratio of observed and stated length between neighbouring markers.

        At least 1, at most that of an effect; the latter where no two are visible at once.
        """
        most = max(LARGEST_SCALE, 1.0 + LARGEST_SLIP_M / self.length_m)
        order = np.argsort(self.arc_length_m)
        between_m = np.diff(self.arc_length_m[order])
        apart_m = np.linalg.norm(np.diff(self.trial.markers.xy_m[:, order], axis=1), axis=2)
        visible = np.isfinite(apart_m).any(axis=0) & (between_m > 0.0)
        if not visible.any():
            return most
        ratios = np.nanmedian(apart_m[:, visible], axis=0) / between_m[visible]
        return float(np.clip(np.median(ratios), 1.0, most))

    @property
    def limit_m(self) -> float:
        """Upper limit of the distance of any marker."""
        return (self.scale + LARGEST_OFFSET) * self.length_m

    @property
    def limits_m(self) -> FloatArray:
        """(markers,) upper limits of the distances, by arc length."""
        return self.scale * self.arc_length_m + LARGEST_OFFSET * self.length_m

    @cached_property
    def _complete_m(self) -> FloatArray:
        """(T, markers) distances where both coordinates were detected, else nan."""
        shown = np.isfinite(self.trial.markers.xy_m).all(axis=2)
        return np.where(shown, self.distance_m, np.nan)

    @cached_property
    def usual_m(self) -> FloatArray:
        """(markers,) median distance; nan of a marker that is never detected."""
        usual_m = np.full(self._complete_m.shape[1], np.nan)
        detected = np.isfinite(self._complete_m).any(axis=0)
        usual_m[detected] = np.nanmedian(self._complete_m[:, detected], axis=0)
        return usual_m

    def beyond(self, limits_m: FloatArray) -> tuple[int, int] | None:
        """The marker whose median exceeds its limit (markers,) most, and the row of its beginning.

        None if there is no such marker.
        """
        excess_m = np.nan_to_num(self.usual_m - limits_m, nan=-np.inf)
        marker = int(np.argmax(excess_m))
        if excess_m[marker] <= 0.0:
            return None
        each_m = self._complete_m[::-1, marker]
        far = each_m > limits_m[marker]
        # The first row with which half of the later rows agree: single noisy rows do not count.
        rows = np.maximum(np.cumsum(np.isfinite(each_m)), 1)
        return marker, int(np.argmax((far & (np.cumsum(far) > 0.5 * rows))[::-1]))
