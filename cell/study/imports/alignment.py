"""The gripper's motion in two files: offset of their clocks, and ratio of their scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from cell.cable.arrays import FloatArray
from cell.study.root_motion import INNERMOST
from cell.study.series import span_m

#: Number of candidate shifts, and of samples for each.
_SHIFTS, _SAMPLES = 1500, 600
#: Minimum overlap of both motions, as a fraction of the shorter one.
_OVERLAP = 0.5
#: Minimum motion of the gripper, relative to the marker's, for estimating a shift.
_MIN_RATIO = 0.1
#: Minimum variance of the gripper's path where both motions overlap, as a share of the whole.
_MIN_SHARE = 0.01
#: Iterations of shift and gain; blocks of equal motion whose residuals count as independent.
_ITERATIONS, _BLOCKS = 4, 10


@dataclass(frozen=True, eq=False)
class Alignment:
    """Least squares between the gripper's path and the same motion in the markers' file.

    shift_s      to be added to the gripper's clock
    std_s        its standard deviation
    gain         motion in the markers' file over that in the gripper's
    unexplained  variance of the residual over that of the gripper's path
    offset_m     (2,) from the gripper's path to the other
    residual_s   rms of the residual over the velocity, while the gripper moves
    is_turned    the gripper's path had to be rotated or mirrored: the axes of a file are wrong
    by_clamp     the other path is that of a point on the gripper, not of the cable's root
    """

    shift_s: float
    std_s: float
    gain: float
    unexplained: float
    offset_m: FloatArray
    residual_s: float
    is_turned: bool = False
    by_clamp: bool = False


@dataclass(frozen=True, eq=False)
class GripperTrack:
    """Times (T,), gripping points (T, 2) and directions (T, 2) in which the cable leaves, of a log.

    leaves  zeros where the clamp's angle is not known: it counts as constant
    """

    t_s: FloatArray
    xy_m: FloatArray
    leaves: FloatArray


def align_root(
    hand: GripperTrack,
    t_s: FloatArray,
    xy_m: FloatArray,
    arcs_m: Sequence[float | None],
    free_gain: bool = False,
) -> Alignment | None:
    """The gripper's path aligned with the cable's root; None = their motions show no alignment.

    The root is a polynomial through the innermost markers, whose slope at the clamp is that of the
    clamp: without this, the cable's inertia makes its motion early.  The change by the last term of
    the polynomial is part of the standard deviation.

    xy_m    (frames, markers, 2) from the gripper on, nan = not visible
    arcs_m  their arc lengths
    """
    known = np.array([float(a) for a in arcs_m[:INNERMOST] if a is not None])
    most = len(known) if len(known) == INNERMOST and np.all(np.diff(known) > 0.0) else 1
    if np.isfinite(xy_m[:, :most]).all(axis=(1, 2)).mean() <= 0.5:
        most = 1
    results = []
    for count in sorted({most, max(most - 1, 1)}, reverse=True):
        weights = _clamped_weights(known[:count]) if count > 1 else np.ones(1)
        ahead_m = float(weights @ known[:count]) if count > 1 else 0.0
        root_m = np.einsum("tmc,m->tc", xy_m[:, :count], weights)
        moved_m = hand.xy_m + ahead_m * hand.leaves
        results.append(align(hand.t_s, moved_m, t_s, root_m, free_gain))
    best, rough = results[0], results[-1]
    if best is None or rough is None:
        return best
    # One marker shows no slope at the clamp: all that the gripper does not explain may be delay.
    error_s = best.residual_s if most == 1 else best.shift_s - rough.shift_s
    return replace(best, std_s=float(np.hypot(best.std_s, error_s)))


def turned_as(hand: GripperTrack, t_s: FloatArray, xy_m: FloatArray) -> GripperTrack | None:
    """The gripper's track rotated or mirrored in the plane as a point (frames, 2) moves.

    A clock does not depend on axes: it shows though those of one file are wrong.
    None = their motions show no alignment
    source  Schönemann 1966 (orthogonal Procrustes problem)
    """
    seen = np.isfinite(xy_m).all(axis=1)
    shift_s, _ = _best_shift((hand.t_s, hand.xy_m), (t_s[seen], xy_m[seen]), any_axes=True)
    if shift_s is None:
        return None
    path, _, _, both = _moved(shift_s, hand.t_s, hand.xy_m, t_s[seen])
    shown = xy_m[seen][both]
    left, _, right = np.linalg.svd(path.T @ (shown - shown.mean(axis=0)))
    turn = left @ right
    return GripperTrack(hand.t_s, hand.xy_m @ turn, hand.leaves @ turn)


def _clamped_weights(arcs_m: FloatArray) -> FloatArray:
    """Weights (n,) of positions at arc lengths for that at 0, up to the clamp's known slope."""
    powers = np.array([0, *range(2, len(arcs_m) + 1)])
    terms = (arcs_m / arcs_m[-1]) ** powers[:, None]
    return np.linalg.solve(terms, np.eye(len(arcs_m))[0])


def align(
    hand_s: FloatArray,
    hand_m: FloatArray,
    marker_s: FloatArray,
    marker_m: FloatArray,
    free_gain: bool = False,
) -> Alignment | None:
    """The gripper's path aligned with that of a point that moves as it does; None = unknown.

    hand_m     (T, 2) path of the gripping point
    marker_m   (frames, 2) positions of the point, nan = not visible
    free_gain  the scale of one of them is not known
    """
    visible = np.isfinite(marker_m).all(axis=1)
    marker_s, marker_m = marker_s[visible], marker_m[visible]
    spans = [span_m(m) if len(m) > 3 else 0.0 for m in (hand_m, marker_m)]
    if min(spans) == 0.0 or (spans[0] < _MIN_RATIO * spans[1] and not free_gain):
        return None
    gain = spans[1] / spans[0] if free_gain else 1.0
    marker = marker_s, marker_m
    shift_s, step_s = _best_shift((hand_s, gain * hand_m), marker)
    if shift_s is None:
        return None
    for _ in range(_ITERATIONS if free_gain else 1):
        shift_s = _refined(shift_s, 2.0 * step_s, (hand_s, gain * hand_m), marker)
        path, middle, velocity, seen = _moved(shift_s, hand_s, gain * hand_m, marker_s)
        off = marker_m[seen] - marker_m[seen].mean(axis=0)
        gain *= float(np.sum(off * path) / np.sum(path**2)) if free_gain else 1.0
    residual = np.sum((off - path) * velocity, axis=1)
    speed = np.cumsum(np.sum(velocity**2, axis=1))
    edges = np.searchsorted(speed, speed[-1] * np.arange(_BLOCKS) / _BLOCKS, side="right")
    sums = np.add.reduceat(residual, np.unique(edges))
    std_s = float(np.linalg.norm(sums) / speed[-1])
    unexplained = float(np.sum((off - path) ** 2) / np.sum(path**2))
    offset_m = marker_m[seen].mean(axis=0) - middle
    squares = np.sum(velocity**2, axis=1)
    residual_s = float(np.sqrt(np.sum((off - path) ** 2 * squares[:, None]) / np.sum(squares**2)))
    return Alignment(shift_s, std_s, gain, unexplained, offset_m, residual_s)


_Track = tuple[FloatArray, FloatArray]


def _best_shift(hand: _Track, marker: _Track, any_axes: bool = False) -> tuple[float | None, float]:
    """The candidate of least variance, None if the motions are not alike, and the step to the next.

    any_axes  the path may be rotated or mirrored
    """
    (hand_s, _), (marker_s, marker_m) = hand, marker
    lasts_s = min(np.ptp(hand_s), np.ptp(marker_s))
    low = marker_s[0] - hand_s[-1] + _OVERLAP * lasts_s
    high = marker_s[-1] - hand_s[0] - _OVERLAP * lasts_s
    sample = np.unique(np.linspace(0, len(marker_s) - 1, _SAMPLES).astype(int))
    candidates = np.linspace(low, high, _SHIFTS)
    sampled = marker_s[sample], marker_m[sample]
    values = _relative_variance(candidates, hand, sampled, any_axes)
    best, step_s = int(np.argmin(values)), float(candidates[1] - candidates[0])
    alike = np.isfinite(values[best]) and values[best] <= 0.5
    return float(candidates[best]) if alike else None, step_s


def _refined(shift_s: float, within_s: float, hand: _Track, marker: _Track) -> float:
    """The shift of least variance near one."""

    def variance(more_s: float) -> float:  # shifts since 1970 are beyond the minimizer's precision
        return float(_relative_variance(np.array([shift_s + more_s]), hand, marker)[0])

    found = minimize_scalar(
        variance, bounds=(-within_s, within_s), method="bounded", options={"xatol": 1e-6}
    )
    return shift_s + float(found.x)


def _moved(
    shift_s: float, hand_s: FloatArray, hand_m: FloatArray, marker_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Path about its mean, the mean, velocity about its mean, and which frames show them."""
    then_s, half_s = marker_s - shift_s, 0.5 * float(np.median(np.diff(hand_s)))
    seen = (then_s >= hand_s[0]) & (then_s <= hand_s[-1])
    path, after, before = (
        np.stack([np.interp(then_s[seen] + d, hand_s, hand_m[:, k]) for k in range(2)], axis=-1)
        for d in (0.0, half_s, -half_s)
    )
    velocity = (after - before) / (2.0 * half_s)
    middle = path.mean(axis=0)
    return path - middle, middle, velocity - velocity.mean(axis=0), seen


def _relative_variance(
    shifts_s: FloatArray, hand: _Track, marker: _Track, any_axes: bool = False
) -> FloatArray:
    """Variance of marker minus gripper over the gripper's, while both are known; per shift."""
    then_s = marker[0] - shifts_s[:, None]
    overlap = (then_s >= hand[0][0]) & (then_s <= hand[0][-1])
    path = np.stack([np.interp(then_s, hand[0], hand[1][:, k]) for k in range(2)], axis=-1)
    shares = overlap / np.maximum(overlap.sum(axis=1, keepdims=True), 1)
    of_path, of_all = _variance(path, shares), float(np.sum(np.var(hand[1], axis=0)))
    residual = _variance(marker[1] - path, shares)
    if any_axes:  # the largest trace of a turned covariance is the sum of its singular values
        about = path - np.einsum("st,stk->sk", shares, path)[:, None]
        covariance = np.einsum("st,stk,tl->skl", shares, about, marker[1])
        sizes = np.linalg.svd(covariance, compute_uv=False).sum(axis=1)
        residual += 2.0 * (np.trace(covariance, axis1=1, axis2=2) - sizes)
    ratio = residual / (of_path + 2e-12)
    return np.where((overlap.sum(axis=1) < 4) | (of_path < _MIN_SHARE * of_all), np.inf, ratio)


def _variance(xy_m: FloatArray, shares: FloatArray) -> FloatArray:
    """Sum of the variances of x and y, each row with shares that sum to 1."""
    mean_m = np.einsum("st,stk->sk", shares, xy_m)
    return np.asarray(np.einsum("st,stk->s", shares, (xy_m - mean_m[:, None]) ** 2))
