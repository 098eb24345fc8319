"""The direction of the cable at its root, which shows the clamp angle and how the clamp turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from cell.cable.arrays import FloatArray
from cell.study.imports.capture import Capture
from cell.study.imports.places import angle_of
from cell.study.imports.shape import root_direction
from cell.study.series import wrapped

#: Largest difference at rest between the root and a correct angle, rad; else an offset is needed.
_TOLERANCE = 0.35
#: As _TOLERANCE, for a root estimated by the line to a single marker, from which a cable droops.
_LINE_TOLERANCE = 1.0
#: Standard deviation of the angle between a clamp and the cable at its root, rad: jaws hold a cable
#: askew, or give way.  In studies with such effects by an independent simulator it was up to 0.1.
_ASKEW = 0.05
#: Accuracy of the root at rest by a curve, rad.
CURVE_STD = 0.0125
#: By one more marker the root's error becomes smaller by at least this factor.
_REFINES = 3.0
#: Number of points that determine a line without a bend; minimum for extrapolating a curve.
A_LINE, MIN_CURVE = 2, 3
#: Rotation above which the cable's root determines the sign of an angle, rad.
MIN_ROTATION = 0.05
#: Number of medians of a trial by which two rotations are compared, and the difference of their
#: ratio from 1 that the cable's bending at its root may cause.
_BLOCKS, _RATIO_TOL = 50, 0.05
#: Standard deviations within which two rotations agree.
_SIGMAS = 3.0


@dataclass(frozen=True)
class RootEnds:
    """The cable's root in a trial that begins at rest, independent of clocks.

    capture    file with the gripper
    first_rad  clamp angle by the root at rest
    last_rad   at the end of the trial; nan = not known
    std_rad    standard deviation of both
    """

    capture: Capture
    first_rad: float
    last_rad: float
    std_rad: float


@dataclass(frozen=True)
class Root:
    """Estimate of the clamp angle by the direction of the cable at its root.

    angle_rad  (rows,) of the markers' file, approximate during motion
    rest_rad   at rest
    is_line    estimated by the line to the only marker, from which a drooping cable departs
    error_rad  estimated error of `rest_rad`, for its few points
    first      at beginning and end of the first trial; None = it begins in motion
    others     of the other trials that begin at rest
    """

    angle_rad: FloatArray
    rest_rad: float
    is_line: bool = False
    error_rad: float = 0.0
    first: RootEnds | None = None
    others: tuple[RootEnds, ...] = ()

    @property
    def ends(self) -> tuple[RootEnds, ...]:
        """Of all trials that begin at rest."""
        return self.others if self.first is None else (self.first, *self.others)

    @property
    def agrees_rad(self) -> float:
        """Largest difference at rest between the root and a correct angle."""
        return _LINE_TOLERANCE if self.is_line else max(_TOLERANCE, _SIGMAS * self.error_rad)

    @property
    def std_rad(self) -> float:
        """Accuracy at rest."""
        return _LINE_TOLERANCE if self.is_line else max(CURVE_STD, self.error_rad)

    @property
    def clamp_std_rad(self) -> float:
        """Accuracy of a clamp angle that is estimated from the cable at rest."""
        return float(np.hypot(_ASKEW, self.std_rad))

    def offset_rad(self, shown_rad: float) -> float:
        """Angle from a direction of the gripper to the cable at rest; 0 or π if that may be."""
        offset = wrapped(self.rest_rad - shown_rad)
        for exact in (0.0, float(np.pi)):
            if abs(wrapped(offset - exact)) < self.std_rad:
                return exact
        return float(round(offset, 4))


def root_of_shape(shape: FloatArray, arcs: Sequence[float | None], from_gripper: bool) -> Root:
    """Clamp angle from points (points, 2) at rest; if the first is away from the gripper, the curve
    is extrapolated to it.

    The error is estimated by a curve without the second point.

    arcs          of the markers
    from_gripper  the first point is the gripping point
    """
    is_line, error_rad = len(shape) <= A_LINE, 0.0
    if (curve := curve_to_gripper(shape, arcs, from_gripper)) is not None:
        angle = angle_of(curve(0.0, 1))
        error_rad = abs(wrapped(angle - angle_of(_without_second(curve)(0.0, 1))))
    else:
        angle = angle_of(root_direction(shape)) if len(shape) > 1 else 0.0
        if not is_line:
            coarse_rad = angle_of(root_direction(np.delete(shape, 1, axis=0)))
            error_rad = abs(wrapped(angle - coarse_rad)) / (_REFINES - 1.0)
    return Root(np.full(1, np.nan), angle, is_line, error_rad)


def curve_to_gripper(
    shape: FloatArray, arcs: Sequence[float | None], from_gripper: bool
) -> CubicSpline | None:
    """(2,) position against arc length, extrapolated to the gripper; None if the first marker is at
    the gripper, or there are too few markers."""
    known = [a for a in arcs if a is not None]
    if from_gripper or len(known) < MIN_CURVE or len(known) != len(shape):
        return None
    return CubicSpline(known, shape)


def start_of(curve: CubicSpline) -> tuple[FloatArray, float]:
    """(2,) position at arc length 0, and its error, m: the change by a curve without the second
    point."""
    return curve(0.0), float(np.linalg.norm(curve(0.0) - _without_second(curve)(0.0)))


def _without_second(curve: CubicSpline) -> CubicSpline:
    return CubicSpline(np.delete(curve.x, 1), np.delete(curve(curve.x), 1, axis=0))


def first_rows(values: FloatArray) -> FloatArray:
    """The first rows, which show the initial value."""
    return values[: max(1, len(values) // 20)]


def turn_signs(
    angle_of_file: Callable[[Capture], FloatArray | None], capture: Capture, root: Root
) -> tuple[float, ...]:
    """Signs with which an angle turns as the cable's root: one; none if it turns by another amount;
    both if that is undetermined.

    angle_of_file  (rows,) angle in a file with the gripper; None = it is not known
    """
    signs = _signs_in_rows(angle_of_file(capture), root)
    return signs if len(signs) != 2 else signs_by_ends(angle_of_file, root)


def signs_by_ends(
    angle_of_file: Callable[[Capture], FloatArray | None], root: Root
) -> tuple[float, ...]:
    """As `turn_signs`, by angles at the beginnings and ends of all trials."""
    x, y = [], []
    for end in root.ends:
        values = angle_of_file(end.capture)
        values = np.empty(0) if values is None else values[np.isfinite(values)]
        if not len(values):
            continue
        x += [np.median(first_rows(values)), np.median(first_rows(values[::-1]))]
        y += [end.first_rad, end.last_rad]
    known = np.isfinite(y)
    std_rad = max((end.std_rad for end in root.ends), default=root.std_rad)
    return agreeing_signs(np.array(x)[known], np.array(y)[known], std_rad)


def agreeing_signs(turned: FloatArray, shown: FloatArray, std_rad: float) -> tuple[float, ...]:
    """As `turn_signs`, by angles (n,) of the gripper and of the cable's root at rest."""
    if len(turned) < 2:
        return 1.0, -1.0
    turned, shown = (v - v.mean() for v in (np.unwrap(turned), np.unwrap(shown)))
    largest = max(np.linalg.norm(turned), np.linalg.norm(shown))
    limit = _RATIO_TOL * largest + _SIGMAS * std_rad
    return tuple(s for s in (1.0, -1.0) if np.linalg.norm(shown - s * turned) <= limit)


def _signs_in_rows(values: FloatArray | None, root: Root) -> tuple[float, ...]:
    """As `turn_signs`, row by row in the markers' file.

    The ratio of their turns is ±1 within its uncertainty: an angle that is merely correlated with
    the clamp's has another one.
    """
    shown_rad = root.angle_rad
    if values is None or len(values) != len(shown_rad):
        return 1.0, -1.0
    rows = np.flatnonzero(np.isfinite(values) & np.isfinite(shown_rad))
    if not len(rows):
        return 1.0, -1.0
    blocks = np.array_split(rows, min(_BLOCKS, len(rows)))
    x, y = (np.array([np.median(v[block]) for block in blocks]) for v in (values, shown_rad))
    if min(np.ptp(x), np.ptp(y)) < MIN_ROTATION:
        return 1.0, -1.0
    x, y = x - x.mean(), y - y.mean()
    ratio = float(x @ y / (x @ x))
    variance = float(np.sum((y - ratio * x) ** 2) + root.std_rad**2) / max(1, len(x) - 2)
    limit = max(_RATIO_TOL, _SIGMAS * float(np.sqrt(variance / (x @ x))))
    return tuple(sign for sign in (1.0, -1.0) if abs(ratio - sign) <= limit)
