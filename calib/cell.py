"""Map from pixels to the cell's plane: a joint fit of lens, camera, robot, jaw and gravity.

Frames are those of `calib.jaw_marks`; P is the cell's plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.copies import independent
from calib.errors import BlurredError, MisfitError, OneSidedError, TooFewError, WrongScaleError
from calib.jaw_marks import (
    CAMERA,
    GRAVITY,
    LENS,
    MARK,
    SCALE,
    SHAPE,
    Gravity,
    JawObservation,
    MarksModel,
    Plate,
    centred,
    parameter_count,
    places_m,
    shapes,
    sideways,
)
from calib.lens import Lens, pose
from calib.plane import PlaneView
from calib.robust import PriorKnowledge, RobustFit, robust_fit
from drivers.interfaces import FloatArray

#: Fewest poses in which the marks must be detected.
LEAST_POSES = 8
#: Prior standard deviations of the marks' pose on the jaw: rotation, rad, and position, m.
_MARK_SPREAD = np.array([0.02, 0.02, 0.02, 0.003, 0.003, 0.003])
_SCALE_SPREAD, MOST_SCALE_ERROR = 0.05, 0.005
#: Distance of marks from their stated places, within the plate and out of its plane: prior standard
#: deviation, and largest allowed, m.
_WITHIN_SPREAD_M, MOST_WITHIN_M = 1e-4, 1.5e-4
_ABOVE_SPREAD_M, MOST_ABOVE_M = 5e-4, 5e-5
#: Distance of the gripping point from the marks' plane per bend of the plate.
_DEPTH_PER_BEND = 4.0
#: Largest rms residual of the marks, px.
MOST_NOISE_PX = 0.6
#: Largest rms residual common to all marks of a pose: the arm's error, in the picture, px.
MOST_ARM_NOISE_PX = 1.5
#: Largest distance that marks may move during the exposure of a picture, px.
MOST_SMEAR_PX = 2.0


@dataclass(frozen=True, eq=False)
class CellFit:
    """The fitted places of camera, robot, marks and plane, with covariance.

    mean, covariance  of the parameters, see `calib.jaw_marks`
    view              pixel → plane
    X_BP, X_TM, X_CB  plane in base, marks in tool, base in camera
    noise_px          of a mark's centre; `arm_noise_px` of the arm, in the picture
    held_out_m        (H, 2) errors of marks at poses that are not in the fit
    residuals_px      (S, M, 2)
    scale             of the marks, estimated / stated, and its standard deviation
    in_plane          whether the arm can only move in a plane, which then is the cell's plane
    bend_m            largest distance of a mark from the plane of all
    left_out          omitted pictures that show the same as others, one sentence each
    """

    mean: FloatArray
    covariance: FloatArray
    view: PlaneView
    X_BP: FloatArray
    X_TM: FloatArray
    X_CB: FloatArray
    noise_px: float
    arm_noise_px: float
    held_out_m: FloatArray
    residuals_px: FloatArray
    scale: tuple[float, float]
    home: FloatArray
    up: FloatArray
    in_plane: bool
    bend_m: float
    left_out: tuple[str, ...] = ()

    def spread_m(self, pixels: FloatArray) -> FloatArray:
        """(…,) standard deviation of the places of pixels (…, 2) in the plane, both axes, m."""
        slopes = self.map_jacobian(pixels.reshape(-1, 2))
        variance = np.einsum("np,pq,nq->n", slopes, self.covariance, slopes)
        return np.asarray(np.sqrt(variance.reshape(-1, 2).sum(axis=1))).reshape(pixels.shape[:-1])

    def map_jacobian(self, pixels: FloatArray) -> FloatArray:
        """(2 N, P) derivatives of (N, 2) pixels' places in the plane, m, by the parameters."""
        return self._jacobian(lambda x: self._view(x).to_plane(pixels).ravel())

    def plane_spread(self) -> tuple[float, float]:
        """Standard deviation of the plane in the base frame: of its origin, m, and turn, rad.

        With `in_plane` the plane's distance is unknown, and not included.
        """
        inverse = np.linalg.inv(self.X_BP)

        def off(x: FloatArray) -> FloatArray:
            X = inverse @ plane_in_base(x, self.home, self.up, self.in_plane)
            return np.array([X[2, 1], X[0, 2], X[1, 0], *X[:3, 3]])  # turned by very little

        slopes = self._jacobian(off)
        variance = np.diag(slopes @ self.covariance @ slopes.T)
        place = variance[3:5] if self.in_plane else variance[3:]
        return float(np.sqrt(place.sum())), float(np.sqrt(variance[:3].sum()))

    def roll(self) -> tuple[float, float]:
        """Roll of the camera against gravity, rad, clockwise in the picture; and its deviation."""

        def angle(x: FloatArray) -> FloatArray:
            X_CP = pose(x[CAMERA]) @ plane_in_base(x, self.home, self.up, self.in_plane)
            return np.array([camera_roll(X_CP)])

        slopes = self._jacobian(angle)
        return float(angle(self.mean)[0]), float(np.sqrt(slopes @ self.covariance @ slopes.T)[0, 0])

    def _view(self, x: FloatArray) -> PlaneView:
        return view_of(x, self.home, self.up, self.in_plane)

    def _jacobian(self, function) -> FloatArray:  # type: ignore[no-untyped-def]
        columns = []
        sizes = np.sqrt(np.diag(self.covariance))
        for k in range(len(sizes)):
            step = np.zeros(len(sizes))
            step[k] = 0.1 * sizes[k]
            columns.append(
                (function(self.mean + step) - function(self.mean - step)) / (2 * step[k])
            )
        return np.stack(columns, axis=1)


def camera_roll(X_CP: FloatArray) -> float:
    """Turn of a camera about its line of sight against the plane's x axis, rad, clockwise."""
    return float(np.arctan2(X_CP[1, 0], X_CP[0, 0]))


def plane_in_base(x: FloatArray, home: FloatArray, up: FloatArray, in_plane: bool) -> FloatArray:
    """(4, 4) X_BP: origin at the gripping point of the gripper at `home` (4, 4), y against gravity.

    A cable bends in the plane of the jaw's plate, to which gravity is nearly parallel.
    in_plane  its normal is the base's z axis, about which the arm turns; else that of the marks
    """
    X_BM = home @ pose(x[MARK])
    a, b = x[GRAVITY]
    side = sideways(up)
    upright = up + a * side[0] + b * side[1]
    z = np.array([0.0, 0.0, 1.0]) if in_plane else X_BM[:3, 2]
    y = upright - (upright @ z) * z
    y = y / np.linalg.norm(y)
    X = np.eye(4)
    X[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    X[:3, 3] = X_BM[:3, 3]
    return X


def view_of(x: FloatArray, home: FloatArray, up: FloatArray, in_plane: bool) -> PlaneView:
    """Map from pixels to the plane, for the parameters (P,)."""
    X_CP = pose(x[CAMERA]) @ plane_in_base(x, home, up, in_plane)
    return PlaneView.from_pose(Lens.of(x[LENS]), X_CP)


def _marks(observation: JawObservation) -> NDArray[np.int64]:
    return np.arange(len(observation.pixels))


def fit_cell(
    shown: Sequence[JawObservation],
    held_out: Sequence[JawObservation],
    plate: Plate,
    lens: Lens,
    lens_covariance: FloatArray,
    gravity: Gravity,
    home: FloatArray,
    *,
    in_plane: bool,
) -> CellFit:
    """Camera, robot, marks and gravity together, from the jaw shown at rest in many poses.

    Pictures that show the same count once: a copy of a fitted one is not held out.
    home    (4, 4) X_BT in which cables are gripped: the plane's origin
    raises  TooFewError, OneSidedError, WrongScaleError, MisfitError
    """
    fitted = independent(shown, _marks)
    validation = independent(held_out, _marks, known=fitted.distinct)
    shown, held_out = fitted.distinct, validation.distinct
    if len(shown) < LEAST_POSES:
        raise TooFewError(
            f"the jaw's marks were found in {len(shown)} of at least {LEAST_POSES} poses",
            "see that they are lit, sharp and not hidden, and widen `limits` if they are narrow",
        )
    _check_poses(shown)
    marks_m, radius_m = plate.marks_m, plate.radius_m
    start = _first_guess(shown, marks_m, lens)
    expected, information = _known(lens, lens_covariance, gravity, len(marks_m))
    observed = shown
    together = 1.0  # weight of the common part of all marks of a pose
    for _ in range(2):
        model = MarksModel(shown, marks_m, gravity, together)
        fit = robust_fit(model, start, PriorKnowledge(expected, information, model.threads))
        plain = MarksModel(shown, marks_m, gravity, 1.0)(fit.mean)[0].reshape(len(shown), -1, 2)
        within, common = _scatter(plain, fit.used)
        start = fit.mean
        shown = [centred(o, start, marks_m, radius_m) for o in observed]
        together = float(min(1.0, within / np.sqrt(len(marks_m)) / max(common, 1e-9)))
    x = fit.mean
    _check_fit(fit, common, shown)
    bend_m = _checked_bend_m(fit, marks_m)
    _check_at_rest(shown)  # a bent plate's marks are no circles either
    covariance = fit.covariance.copy()
    covariance[MARK, MARK][5, 5] += (_DEPTH_PER_BEND * bend_m) ** 2
    return CellFit(
        x,
        covariance,
        view_of(x, home, gravity.up, in_plane),
        plane_in_base(x, home, gravity.up, in_plane),
        pose(x[MARK]),
        pose(x[CAMERA]),
        within,
        float(np.sqrt(max(0.0, common**2 - within**2 / len(marks_m)))),
        _held_out(
            x,
            [centred(o, x, marks_m, radius_m) for o in held_out],
            marks_m,
            home,
            gravity.up,
            in_plane,
        ),
        plain,
        (1.0 + float(x[SCALE]), float(np.sqrt(covariance[SCALE, SCALE]))),
        home,
        gravity.up,
        in_plane,
        bend_m,
        (*fitted.left_out, *validation.left_out),
    )


# --- the fit ----------------------------------------------------------------------------------


def _known(
    lens: Lens, lens_covariance: FloatArray, gravity: Gravity, marks: int
) -> tuple[FloatArray, FloatArray]:
    """(P,) prior mean of the parameters and (P, P) prior information."""
    count = parameter_count(marks)
    expected = np.zeros(count)
    expected[LENS] = lens.numbers
    information = np.zeros((count, count))
    information[LENS, LENS] = np.linalg.inv(lens_covariance)
    information[MARK, MARK] = np.diag(1.0 / _MARK_SPREAD**2)
    information[SCALE, SCALE] = 1.0 / _SCALE_SPREAD**2
    information[GRAVITY, GRAVITY] = np.eye(2) / gravity.spread_rad**2
    spread_m = np.repeat([_WITHIN_SPREAD_M, _ABOVE_SPREAD_M], [2 * marks - 4, marks - 3])
    information[SHAPE, SHAPE] = np.diag(1.0 / spread_m**2)
    return expected, information


def _first_guess(shown: Sequence[JawObservation], marks_m: FloatArray, lens: Lens) -> FloatArray:
    flat = np.column_stack([marks_m, np.zeros(len(marks_m))])
    points = np.concatenate([flat @ s.X_BT[:3, :3].T + s.X_BT[:3, 3] for s in shown])
    pixels = np.concatenate([s.pixels for s in shown])
    solved, turn, shift = cv2.solvePnP(
        points, lens.ideal(pixels), lens.matrix, None, flags=cv2.SOLVEPNP_SQPNP
    )
    if not solved:
        raise MisfitError(
            "no place of the camera explains what it sees",
            "check the marks on the jaw, and that camera and robot stood still",
        )
    start = np.zeros(parameter_count(len(marks_m)))
    start[LENS] = lens.numbers
    start[CAMERA] = np.concatenate([turn.ravel(), shift.ravel()])
    return start


def _scatter(by_pose: FloatArray, used: NDArray[np.bool_]) -> tuple[float, float]:
    """Standard deviations, px: of a mark about its pose's mean, and of those means.

    by_pose  (S, M, 2) residuals, px
    used     (S M,) False = an outlier
    """
    good = np.all(used.reshape(len(by_pose), -1), axis=1)
    chosen = by_pose[good] if np.count_nonzero(good) >= 4 else by_pose
    means = chosen.mean(axis=1)
    count = chosen.shape[1]
    within = np.sqrt(np.sum((chosen - means[:, None]) ** 2) / (2 * len(chosen) * (count - 1)))
    common = np.sqrt(np.sum(means**2) / max(1, 2 * len(chosen) - 9))
    return float(max(within, 1e-4)), float(common)


def _held_out(
    x: FloatArray,
    shown: Sequence[JawObservation],
    marks_m: FloatArray,
    home: FloatArray,
    up: FloatArray,
    in_plane: bool,
) -> FloatArray:
    """(H, 2) errors of the map, m, at the marks of held-out poses."""
    if not shown:
        return np.empty((0, 2))
    X_CP = pose(x[CAMERA]) @ plane_in_base(x, home, up, in_plane)
    X_PB = np.linalg.inv(plane_in_base(x, home, up, in_plane))
    lens = Lens.of(x[LENS])
    in_mark = np.column_stack([places_m(x, marks_m), np.ones(len(marks_m))])
    errors = []
    for view in shown:
        in_plane_m = (in_mark @ (X_PB @ view.X_BT @ pose(x[MARK])).T)[:, :3]
        # the line of sight of each pixel, at the depth at which the mark is
        lifted = X_CP.copy()
        rays = (lens.ideal(view.pixels) - [lens.cx_px, lens.cy_px]) / [lens.fx_px, lens.fy_px]
        ways = np.column_stack([rays, np.ones(len(rays))]) @ lifted[:3, :3]
        eye = -lifted[:3, :3].T @ lifted[:3, 3]
        reach = (in_plane_m[:, 2] - eye[2]) / ways[:, 2]
        errors.append((eye + reach[:, None] * ways - in_plane_m)[:, :2])
    return np.concatenate(errors)


# --- refusals ---------------------------------------------------------------------------------


def _check_poses(shown: Sequence[JawObservation]) -> None:
    places = np.array([s.X_BT[:3, 3] for s in shown])
    sizes = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if sizes[1] < 0.1 * sizes[0] or sizes[0] < 1e-3:
        raise OneSidedError(
            "the robot's poses lie on a line", "let it move up and down as well as left and right"
        )


def _check_at_rest(shown: Sequence[JawObservation]) -> None:
    smeared = [one.name for one in shown if one.smear_px > MOST_SMEAR_PX]
    if len(smeared) > len(shown) // 3:
        raise BlurredError(
            f"the gripper moved during exposure: in {len(smeared)} of {len(shown)} pictures its "
            "marks "
            f"are smeared, by {np.median([one.smear_px for one in shown]):.1f} px in the median, "
            f"allowed {MOST_SMEAR_PX:g} px: {', '.join(smeared[:3])} …",
            "let it come to rest before each picture, shorten the exposure; if it rested, see that "
            "the plate is flat",
        )


def _check_fit(fit: RobustFit, common: float, shown: Sequence[JawObservation]) -> None:
    x, outliers = fit.mean, 1.0 - float(np.mean(fit.used))
    if fit.noise_px > MOST_NOISE_PX or common > MOST_ARM_NOISE_PX or outliers > 0.2:
        worst = np.linalg.norm(fit.residuals.reshape(len(shown), -1, 2), axis=2).mean(axis=1)
        raise MisfitError(
            f"the marks are {max(common, fit.noise_px):.2f} px rms from where they must be, "
            f"{outliers:.0%} of them far off, most at {shown[int(np.argmax(worst))].name}",
            "check that camera and plate are tight, the plate flat, its marks as described, and "
            "that the gripper rested in every picture",
        )
    if abs(x[SCALE]) > MOST_SCALE_ERROR:
        raise WrongScaleError(
            f"the marks on the jaw are {1e2 * x[SCALE]:+z.2f} % larger than stated, measured by "
            "the robot's own way",
            "measure their distances and correct them, or check the arm's model",
        )


def _checked_bend_m(fit: RobustFit, marks_m: FloatArray) -> float:
    """Largest distance of a mark from the plane of all, m.

    raises  MisfitError: the plate is bent, or a mark is not at its stated place
    """
    deformations = shapes(marks_m)
    shift_m = np.tensordot(fit.mean[SHAPE], deformations, axes=1)
    variance = np.einsum("wmj,wv,vmj->mj", deformations, fit.covariance[SHAPE, SHAPE], deformations)
    height, margin = abs(shift_m[:, 2]), 2.0 * np.sqrt(variance[:, 2])
    worst = int(np.argmax(height))
    if height[worst] > MOST_ABOVE_M + margin[worst]:
        raise MisfitError(
            f"the plate on the jaw is bent: mark {worst + 1} is {height[worst] * 1e3:.2f} mm off "
            f"the plane of all, allowed {MOST_ABOVE_M * 1e3:g} mm",
            "glue it flat on something stiff, or replace it",
        )
    away = np.linalg.norm(shift_m[:, :2], axis=1)
    far = int(np.argmax(away))
    if away[far] > MOST_WITHIN_M:
        raise MisfitError(
            f"mark {far + 1} on the jaw is {away[far] * 1e3:.2f} mm from its stated place, "
            f"allowed {MOST_WITHIN_M * 1e3:g} mm",
            "measure the plate again and correct vision.jaw.discs_m",
        )
    return float(height[worst])
