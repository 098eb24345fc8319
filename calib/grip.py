"""Grip of a cable: gripping point, clamp angle and free length, from its shape at rest.

Near the jaw a cable is bent most, so that its chord is not its direction there.  At rest its
curvature is rest curvature + moment of its weight beyond / rigidity.  The moment, up to a factor,
follows from the picture; rigidity and rest curvature are the same in all poses, the moment differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit as student_quantile

from calib.cable_line import CableLine
from calib.errors import MisfitError, TooFewError
from drivers.interfaces import FloatArray

#: Fewest poses, and largest apparent motions of a cable in the jaws between poses.
LEAST_POSES = 5
MOST_MOVED_M, MOST_TURNED_RAD = 0.0003, 0.02
_MOST_OUTLIERS = 0.25  # share of the poses, with something behind the tip or the jaw's edge
#: The part of the cable whose shape is fitted, from the jaw on.
_SHARE, _BEGINNING = 0.5, 0.2
#: Terms of compliance and of rest curvature along the cable.
_COMPLIANCE_TERMS, _REST_TERMS = 3, 2
_Y, _ANGLE, _SHAPE = 0, 1, slice(2, None)
_ITERATIONS = 5
#: Relative size of singular values below which a direction is not determined by the shapes.
_RCOND = 1e-6
_NAMES = ("gripping point", "gripping point", "clamp angle", "free length")
#: A lever arm, m², that makes the terms' factors of the order of one.
_LEVER_M2, _CURVATURE_1_PER_M = 1e-3, 100.0


@dataclass(frozen=True, eq=False)
class GripView:
    """A cable at rest: where the jaw's marks are, (3,) x, y and angle: m, m, rad; and its line."""

    name: str
    marks: FloatArray
    line: CableLine


@dataclass(frozen=True, eq=False)
class GripFit:
    """Grip of a cable, in the frame of the jaw's marks: x away from the cable, y up.

    mean        (4,) gripping point x and y, m; clamp angle, positive = pointing down relative to
                the marks, rad; free length, m
    covariance  (4, 4)
    half_95     (4,) half widths of their 95 % intervals
    used        (S,) False = an outlier, whose cable is longer or shorter
    by_pose     (U, 4) estimate from each used pose alone, with the common stiffness
    residual_m  (U,) rms residual across the line
    """

    mean: FloatArray
    covariance: FloatArray
    half_95: FloatArray
    used: NDArray[np.bool_]
    by_pose: FloatArray
    residual_m: FloatArray

    @property
    def repeatability(self) -> FloatArray:
        """(4,) standard deviations between poses."""
        return np.asarray(self.by_pose.std(axis=0, ddof=1))


def fit_grip(views: Sequence[GripView], map_std_m: float = 0.0) -> GripFit:
    """Gripping point, clamp angle and free length from views of one cable.

    map_std_m  standard deviation of a point's place by the map, which does not average out
    raises     TooFewError, MisfitError
    """
    if len(views) < LEAST_POSES:
        raise TooFewError(
            f"the cable was measured in {len(views)} of at least {LEAST_POSES} poses",
            "see that jaw and cable are in the picture, lit and sharp",
        )
    shapes = [_Shape.of(view) for view in views]
    lengths = np.array([s.length_m for s in shapes])
    used = np.abs(lengths - np.median(lengths)) < MOST_MOVED_M
    if np.count_nonzero(~used) > _MOST_OUTLIERS * len(views):
        used[:] = True  # too many for outliers: it slides
    shapes = [s for s, good in zip(shapes, used, strict=True) if good]
    count = len(shapes)
    ends = np.array([(s.edge_m[0], s.length_m) for s in shapes])
    joint, by_pose, residual_m = _fit(shapes)
    without = np.array([_fit(shapes[:k] + shapes[k + 1 :])[0][:2] for k in range(count)])
    mean = np.array([ends[:, 0].mean(), joint[_Y], joint[_ANGLE], ends[:, 1].mean()])
    # influence of each pose on the mean: Tukey's jackknife
    influence = np.column_stack([ends[:, 0], -(count - 1) * without, ends[:, 1]])
    influence -= influence.mean(axis=0)
    sampling = influence.T @ influence / (count * (count - 1))
    per_axis = map_std_m / np.sqrt(2.0)
    common = np.array([per_axis, per_axis, per_axis / mean[3], map_std_m])
    # error of the shape's law, by comparison with the beginning alone, bent evenly
    alternative = _fit([s.beginning() for s in shapes])[0]
    common[1:3] = np.hypot(common[1:3], 0.5 * np.abs(alternative[:2] - joint[:2]))
    quantile = float(student_quantile(count - 1, 0.975))
    half = np.hypot(quantile * np.sqrt(np.diag(sampling)), 1.96 * common)
    fit = GripFit(
        mean,
        sampling + np.diag(common**2),
        half,
        used,
        np.column_stack([ends[:, :1], by_pose, ends[:, 1:]]),
        residual_m,
    )
    _check(fit, [view for view, good in zip(views, used, strict=True) if good])
    return fit


@dataclass(frozen=True, eq=False)
class _Shape:
    """One view in the frame of its marks.

    edge_m   (2,) the cable's point at the jaw's edge
    along_m  (N,) arc lengths of the fitted points (N, 2)
    arcs_m   (K,) arc lengths of the smoothed line, with `turned` (K, T): the angle by which each
             term of the curvature turns it, rad
    """

    edge_m: FloatArray
    along_m: FloatArray
    points_m: FloatArray
    arcs_m: FloatArray
    turned: FloatArray
    length_m: float

    @classmethod
    def of(cls, view: GripView) -> _Shape:
        """The view's points in the marks' frame."""
        x, y, angle = view.marks
        c, s = np.cos(angle), np.sin(angle)
        to_marks = np.array([[c, -s], [s, c]])
        line = view.line
        steps = np.linalg.norm(np.diff(line.smooth_m, axis=0), axis=1)
        arcs = np.concatenate([[0.0], np.cumsum(steps)])
        length, level = float(arcs[-1]), line.smooth_m[:, 0]
        beyond = np.concatenate(
            [np.cumsum((0.5 * (level[1:] + level[:-1]) * steps)[::-1])[::-1], [0.0]]
        )
        lever = (beyond - level * (length - arcs)) / _LEVER_M2
        share = arcs / length
        terms = [lever * share**k for k in range(_COMPLIANCE_TERMS)]
        terms += [share**k for k in range(_REST_TERMS)]
        near = line.along_m < _SHARE * length
        return cls(
            (line.edge_m - [x, y]) @ to_marks,
            line.along_m[near],
            (line.points_m[near] - [x, y]) @ to_marks,
            arcs,
            _integral(_CURVATURE_1_PER_M * np.stack(terms, axis=1), arcs),
            length,
        )

    def beginning(self) -> _Shape:
        """Only the first part, with the moment's factor and a rest curvature even along it."""
        near = self.along_m < _BEGINNING * self.length_m
        terms = [0, _COMPLIANCE_TERMS]
        return replace(
            self,
            along_m=self.along_m[near],
            points_m=self.points_m[near],
            turned=self.turned[:, terms],
        )

    def residuals(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N,) distances of the points across the line by parameters (P,), (N, P) derivatives, m.

        Parameters: the line's y at the jaw's edge, its angle there, factors of the curvature.
        """
        angle = x[_ANGLE] + self.turned @ x[_SHAPE]
        c, s = np.cos(angle), np.sin(angle)
        start = np.array([self.edge_m[0], x[_Y]])
        path = start - _integral(np.stack([c, s], axis=1), self.arcs_m)
        turns = np.column_stack([np.zeros_like(angle), np.ones_like(angle), self.turned])
        dx, dy = (
            _integral(s[:, None] * turns, self.arcs_m),
            -_integral(c[:, None] * turns, self.arcs_m),
        )
        dy[:, _Y] = 1.0
        at = [_at(self.along_m, self.arcs_m, v) for v in (path, c, s, dx, dy)]
        across = np.stack([-at[2], at[1]], axis=1)
        residuals = np.sum(across * (self.points_m - at[0]), axis=1)
        return residuals, across[:, :1] * at[3] + across[:, 1:] * at[4]


def _fit(shapes: Sequence[_Shape]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(P,) joint parameters, (S, 2) y and angle of each pose alone, (S,) rms residuals, m."""
    x = np.zeros(2 + shapes[0].turned.shape[1])
    x[_Y] = np.mean([s.edge_m[1] for s in shapes])
    for _ in range(_ITERATIONS):
        parts = [s.residuals(x) for s in shapes]
        slopes = np.concatenate([p[1] for p in parts])
        size = np.linalg.norm(slopes, axis=0)
        step = np.linalg.lstsq(slopes / size, np.concatenate([p[0] for p in parts]), rcond=_RCOND)[
            0
        ]
        x = x + step / size
    parts = [s.residuals(x) for s in shapes]
    alone = np.array([x[:2] + np.linalg.lstsq(j[:, :2], r, rcond=None)[0] for r, j in parts])
    return x, alone, np.array([np.sqrt(np.mean(r**2)) for r, _ in parts])


def _integral(values: FloatArray, along: FloatArray) -> FloatArray:
    """(K, T) integral of (K, T) values from the first of (K,) places on."""
    parts = 0.5 * (values[1:] + values[:-1]) * np.diff(along)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(parts, axis=0)])


def _at(places: FloatArray, along: FloatArray, values: FloatArray) -> FloatArray:
    """Values (K,) or (K, T) between, at (N,) places."""
    if values.ndim == 1:
        return np.asarray(np.interp(places, along, values))
    return np.stack([np.interp(places, along, v) for v in values.T], axis=1)


def _check(fit: GripFit, views: Sequence[GripView]) -> None:
    """Raises MisfitError: the cable did not stay where it was between the jaws."""
    deviations = np.abs(fit.by_pose - np.median(fit.by_pose, axis=0))
    limits = np.array([MOST_MOVED_M, MOST_MOVED_M, MOST_TURNED_RAD, MOST_MOVED_M])
    pose, axis = divmod(int(np.argmax(deviations / limits)), len(_NAMES))
    if deviations[pose, axis] > limits[axis]:
        moved = (
            f"{np.degrees(deviations[pose, axis]):.1f}°"
            if axis == _NAMES.index("clamp angle")
            else f"{deviations[pose, axis] * 1e3:.2f} mm"
        )
        raise MisfitError(
            f"the cable moved in the jaws: its {_NAMES[axis]} at {views[pose].name} is {moved} "
            "away from that of the other poses",
            "grip harder, clean the pads, let the cable come to rest; then do it again",
        )
