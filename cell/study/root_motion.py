"""Motion of the cable's root by its markers, compared with the gripper's.

The cable is clamped, so its root moves as the gripping point does.  The root is extrapolated from
the innermost markers.  This needs no model of the cable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cell.cable.arrays import FloatArray
from cell.study.data import Trial

#: Markers by which the root is extrapolated, and rows in which they must be detected.
INNERMOST, _FEWEST_ROWS, _MOST_ROWS = 3, 20, 2000
#: Least motion of the gripper, share of the outermost marker's arc length.
_LEAST_WAY = 0.1
#: Delays between both clocks at which they are compared, s: other checks test the delay.
_DELAYS_S = np.linspace(-0.1, 0.1, 81)
#: Rows of a running median against noise and single wrong values.
_MEDIAN_OF = 5


@dataclass(frozen=True)
class RootMotion:
    """The root's motion compared with the gripper's, at the delay of the least difference.

    way_m      extent of the gripper's motion along an axis
    scale      ratio of the root's motion and the gripper's, by least squares
    turned_rad  angle from the direction of the gripper's motion to that of the root's
    apart_m    largest distance of both, each relative to its median
    uncertainty_m  largest change of the root by the last term of the extrapolation, and its noise
    """

    way_m: float
    scale: float
    turned_rad: float
    apart_m: float
    uncertainty_m: float

    @property
    def excess(self) -> float:
        """Difference of both motions beyond twice the uncertainty, over the gripper's motion."""
        return (self.apart_m - 2.0 * self.uncertainty_m) / self.way_m


def root_motion(trial: Trial, arc_length_m: FloatArray, noise_m: float) -> RootMotion | None:
    """The root's motion; None if the gripper hardly moves, or too few markers show the root.

    None, too, if the gripper's motion is integrated from a sensor's and has its own error.

    arc_length_m  (markers,) from the gripping point
    noise_m       of one coordinate in one frame; nan = unknown
    """
    t_s, xy_m = trial.markers.t_s, trial.markers.xy_m
    shown = np.asarray(np.isfinite(xy_m).all(axis=2))
    usable = np.flatnonzero((shown.mean(axis=0) > 0.5) & np.isfinite(arc_length_m))
    order = usable[np.argsort(arc_length_m[usable])][:INNERMOST]
    arcs_m = arc_length_m[order]
    rows = np.flatnonzero(shown[:, order].all(axis=1))
    if (
        trial.hand_drift is not None
        or len(order) < 2
        or np.any(np.diff(arcs_m) <= 0.0)
        or len(rows) < _FEWEST_ROWS
    ):
        return None
    rows = rows[:: 1 + len(rows) // _MOST_ROWS]
    root_m = root_places_m(xy_m[rows][:, order], arcs_m)
    rough_m = root_places_m(xy_m[rows][:, order], arcs_m[:-1])
    delayed_m = np.array([trial.gripper_m(t_s[rows] - delay_s) for delay_s in _DELAYS_S])
    way_m = float(np.ptp(trial.gripper_m(t_s[rows]), axis=0).max())
    if way_m < _LEAST_WAY * float(arc_length_m[usable].max()):
        return None
    apart_m = root_m - delayed_m
    apart_m = apart_m - np.median(apart_m, axis=1, keepdims=True)
    best = int(np.argmin(np.sum(apart_m**2, axis=(1, 2))))
    hand, root = ((v - v.mean(axis=0)) @ [1.0, 1.0j] for v in (delayed_m[best], root_m))
    ratio = complex(np.vdot(hand, root) / np.vdot(hand, hand))
    term_m = root_m - rough_m
    uncertainty_m = _farthest(term_m - np.median(term_m, axis=0))
    noise_m = float(np.linalg.norm(_weights(arcs_m)) * np.nan_to_num(noise_m))
    apart = _farthest(apart_m[best])
    return RootMotion(way_m, abs(ratio), float(np.angle(ratio)), apart, uncertainty_m + noise_m)


def root_places_m(xy_m: FloatArray, arc_length_m: FloatArray) -> FloatArray:
    """(T, 2) root by markers (T, n, 2) in the order of their arc lengths (n,), at most the first 3.

    nan where one of them was not detected.
    """
    arcs_m = arc_length_m[:INNERMOST]
    root_m: FloatArray = np.einsum("tmc,m->tc", xy_m[:, : len(arcs_m)], _weights(arcs_m))
    return root_m


def _weights(arcs_m: FloatArray) -> FloatArray:
    """Weights of values at arc lengths (n,) for the value at 0 (Lagrange interpolation)."""
    n = len(arcs_m)
    others = [np.delete(arcs_m, i) for i in range(n)]
    return np.array([np.prod(o / (o - arcs_m[i])) for i, o in enumerate(others)])


def _farthest(xy_m: FloatArray) -> float:
    """Largest size of vectors (T, 2), each the median of some successive rows."""
    windows = np.lib.stride_tricks.sliding_window_view(xy_m, _MEDIAN_OF, axis=0)
    return float(np.linalg.norm(np.median(windows, axis=-1), axis=1).max())
