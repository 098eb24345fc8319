"""Computes calibrations from measurements, their stored content, and the drift since then."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from calib.board import Board, BoardView, find_board
from calib.camera import CameraFit, different_views, fit_camera, picture_grid
from calib.cell import CellFit, fit_cell
from calib.errors import CalibrationError, TooFewError, WrongBoardError
from calib.hand_eye import classic_view
from calib.jaw_marks import Gravity, MarksModel, Plate, parameter_count
from calib.lens import Lens
from calib.store import StoredCalibration
from calib.thread import find_thread
from calib.timing import Delay, arm_lag, camera_latency
from cell.cable.arrays import FloatArray
from cell.calibration.measure import detect_marks, marks_m, matrix_of
from cell.calibration.raw import DetectedMove, NamedImage, ShownCell
from cell.settings import Settings
from cell.settings.calibrated import CIRCLE_95, devices_of
from cell.settings.translate import pose_of, vision_of

#: A base is mounted level to this without a plumb line: standard deviation, rad.
LEVEL_SPREAD_RAD = 0.0035
#: Half of a normal law's 95 % interval, in standard deviations.
_SIGMAS_95 = 1.96
#: Stretch of a board from which a warning is given.
_STRETCH_REPORTED = 1e-3


def camera_from(
    pictures: Sequence[NamedImage], board: Board
) -> tuple[CameraFit, tuple[BoardView, ...], tuple[str, ...]]:
    """Fitted lens, the views that it was fitted to, and messages about the other pictures.

    Corners are detected and a lens is fitted; both are repeated with this lens.
    raises  CalibrationError
    """
    troubles: list[str] = []
    first = _views(pictures, board, None, troubles)
    lens = fit_camera(first, board).lens
    different = different_views(first)
    troubles += different.left_out
    names = {view.name for view in different.distinct}
    repeated = _views([p for p in pictures if p.name in names], board, lens, [])
    views = different_views(repeated).distinct
    fit = fit_camera(views, board)
    return fit, views, (*troubles, *doubts_about(fit))


def doubts_about(fit: CameraFit) -> tuple[str, ...]:
    """Warnings about a fitted lens and its board, with remedies."""
    stretch, spread = fit.stretch
    if abs(stretch) < max(_STRETCH_REPORTED, 3.0 * spread):
        return ()
    return (
        f"the board is {1e2 * stretch:+z.2f} % longer across than upright, against its "
        "description: a printer stretched it; that is allowed for, but print it at 100 %",
    )


def _views(
    pictures: Sequence[NamedImage], board: Board, lens: Lens | None, troubles: list[str]
) -> list[BoardView]:
    views, errors = [], []
    for picture in pictures:
        try:
            view = find_board(picture.image, board, picture.name, lens)
        except CalibrationError as error:
            errors.append(error)
            troubles.append(str(error))
            continue
        if view is None:
            troubles.append(f"{picture.name}: the board was not found")
        else:
            views.append(view)
    if len(errors) > len(pictures) // 2:
        raise errors[0]
    return views


def stored_camera(fit: CameraFit, settings: Settings) -> StoredCalibration:
    """Calibration file content of a fitted lens."""
    return StoredCalibration(
        "camera",
        datetime.now(UTC),
        {
            "pictures": len(fit.views),
            "corners": sum(v.corners for v in fit.views),
            "outliers": fit.outliers,
        },
        _only(devices_of(settings), "camera", "width_px", "height_px"),
        {
            "noise_px": fit.noise_px,
            "spread_95_px": CIRCLE_95 * float(fit.spread_px.max()),
            "halves_rms_px": float(np.sqrt(np.mean(fit.halves_px**2))),
        },
        {"lens": fit.lens.numbers, "warp_m": fit.warp_m, "stretch": fit.stretch[0]},
        fit.covariance,
    )


def cell_from(shown: ShownCell, camera: StoredCalibration, settings: Settings) -> CellFit:
    """Plane, robot, marks and gravity.  Raises CalibrationError."""
    marks = vision_of(settings).marks
    bare = shown.without
    threads = () if bare is None else tuple(find_thread(image, bare) for image in shown.threads)
    role = {name: [p for p in shown.poses if p.role == name] for name in ("fit", "held_out")}
    observations = detect_marks(role["fit"], marks)
    if len(observations) < 0.7 * len(role["fit"]):
        if len(detect_marks([p.mirrored for p in role["fit"]], marks)) > len(observations):
            raise WrongBoardError("the picture is mirrored", "switch mirroring off in the camera")
        raise TooFewError(
            f"the marks on the jaw were found in {len(observations)} of {len(role['fit'])} poses",
            f"see that all {len(marks.centres_m)} are lit, sharp, in the picture and not hidden",
        )
    return fit_cell(
        observations,
        detect_marks(role["held_out"], marks),
        Plate(marks_m(marks), marks.radius_m),
        Lens.of(camera.array("lens", (9,))),
        camera.covariance,
        Gravity(np.array([0.0, 1.0, 0.0]), LEVEL_SPREAD_RAD, threads),
        matrix_of(pose_of(settings.motion.home)),
        in_plane=True,
    )


def disagreement_m(
    fit: CellFit, shown: ShownCell, camera: StoredCalibration, settings: Settings
) -> FloatArray:
    """(R, C) distance over the picture between the points of the classic map and the joint fit.

    See `calib.hand_eye`; m in the plane.
    """
    marks = vision_of(settings).marks
    observations = detect_marks([p for p in shown.poses if p.role == "fit"], marks)
    lens = Lens.of(camera.array("lens", (9,)))
    classic = classic_view(observations, marks_m(marks), lens, fit.X_BP)
    grid = picture_grid((settings.camera.width_px, settings.camera.height_px))
    return np.asarray(np.linalg.norm(classic.to_plane(grid) - fit.view.to_plane(grid), axis=-1))


def stored_cell(fit: CellFit, classic_m: FloatArray, settings: Settings) -> StoredCalibration:
    """Calibration file content of a fitted cell; `classic_m` is its `disagreement_m`."""
    size = (settings.camera.width_px, settings.camera.height_px)
    spread_m = fit.spread_m(picture_grid(size))
    origin_m, turn_rad = fit.plane_spread()
    roll_rad, roll_std = fit.roll()
    held_out = np.linalg.norm(fit.held_out_m, axis=1)
    lens = fit.view.lens
    assert lens is not None
    return StoredCalibration(
        "cell",
        datetime.now(UTC),
        {
            "poses": len(fit.residuals_px),
            "held_out": len(held_out) // len(vision_of(settings).marks.centres_m),
        },
        _only(devices_of(settings), "camera", "width_px", "height_px", "arm"),
        {
            "map_95_m": CIRCLE_95 * float(spread_m.max()),
            "map_rms_m": float(np.sqrt(np.mean(spread_m**2))),
            "held_out_rms_m": float(np.sqrt(np.mean(held_out**2))) if len(held_out) else np.nan,
            "held_out_max_m": float(held_out.max()) if len(held_out) else np.nan,
            "classic_rms_m": float(np.sqrt(np.mean(classic_m**2))),
            "classic_max_m": float(classic_m.max()),
            "bend_m": fit.bend_m,
            "noise_px": fit.noise_px,
            "arm_noise_px": fit.arm_noise_px,
            "plane_origin_95_m": CIRCLE_95 * origin_m,
            "plane_turn_95_rad": _SIGMAS_95 * turn_rad,
            "roll_95_rad": _SIGMAS_95 * roll_std,
        },
        {
            "homography": fit.view.homography,
            "lens": lens.numbers,
            "roll_rad": roll_rad,
            "marks_scale": fit.scale[0],
            "plane_in_arm": fit.X_BP,
            "marks_in_tool": fit.X_TM,
            "parameters": fit.mean,
        },
        fit.covariance,
    )


@dataclass(frozen=True)
class Times:
    """Latency of the camera's stamps and lag of the arm."""

    latency: Delay
    lag: Delay


def times_from(move: DetectedMove) -> Times:
    """Both delays from one motion.  Raises CalibrationError."""
    return Times(
        camera_latency(move.stamps_s, move.detected_m, move.gripper_log),
        arm_lag(move.commanded, move.gripper_log),
    )


def stored_times(
    times: Times, settings: Settings, frames: int, latency_s: float
) -> StoredCalibration:
    """Calibration file content of the delays; `latency_s` is what the driver already corrects."""
    return StoredCalibration(
        "time",
        datetime.now(UTC),
        {"frames": frames},
        _only(devices_of(settings), "camera", "arm", "lookahead_s"),
        {
            "latency_95_s": times.latency.half_width_s,
            "lag_95_s": times.lag.half_width_s,
            "latency_rms_m": times.latency.rms_m,
            "lag_rms_m": times.lag.rms_m,
        },
        {"latency_s": latency_s + times.latency.value_s, "lag_s": times.lag.value_s},
    )


# --- drift since the calibration --------------------------------------------------------------


@dataclass(frozen=True)
class Drift:
    """Drift of the cell since its calibration; `sentence` and `command` are for a person.

    moved_m     mean shift of the marks relative to the stored map
    residual_m  rms of the residual after this shift
    """

    good: bool
    sentence: str
    command: str | None
    moved_m: float
    residual_m: float
    latency_change_s: float | None


def today(
    shown: ShownCell, cell: StoredCalibration, times: Times | None, settings: Settings, config: str
) -> Drift:
    """Compare the cell with its calibration.  Raises CalibrationError: no marks were detected."""
    marks = vision_of(settings).marks
    observations = detect_marks(shown.poses, marks)
    if not observations:
        raise TooFewError(
            "the marks on the jaw were found in none of the poses",
            "see that they are lit and that the camera looks at the gripper; then check again",
        )
    limits = settings.calibration
    assert limits is not None
    mean = cell.array("parameters", (parameter_count(len(marks.centres_m)),))
    gravity = Gravity(np.array([0.0, 1.0, 0.0]), LEVEL_SPREAD_RAD)
    errors_px = MarksModel(observations, marks_m(marks), gravity, 1.0)(mean)[0]
    homography = cell.array("homography", (3, 3))
    scale_m = float(np.sqrt(abs(np.linalg.det(homography[:2, :2]))) / abs(homography[2, 2]))
    shift = errors_px.mean(axis=0)
    moved_m = float(np.linalg.norm(shift)) * scale_m
    rms_m = float(np.sqrt(np.mean(np.sum((errors_px - shift) ** 2, axis=1)))) * scale_m
    bound_m = limits.max_error_m
    change_s = None if times is None else times.latency.value_s
    command = f"cell calibrate cell --config {config}"
    if moved_m > bound_m:
        sentence = f"the camera, or the plate on the jaw, moved by {moved_m * 1e3:.2f} mm"
        return Drift(False, sentence, command, moved_m, rms_m, change_s)
    if rms_m > bound_m:
        sentence = f"the map is wrong by {rms_m * 1e3:.2f} mm rms: the camera turned, or its lens"
        command = f"cell calibrate --config {config}"
        return Drift(False, sentence, command, moved_m, rms_m, change_s)
    if change_s is not None and abs(change_s) > limits.max_time_error_s:
        sentence = f"recalibrate time: the camera's latency changed by {change_s * 1e3:+z.2f} ms"
        command = f"cell calibrate time --config {config}"
        return Drift(False, sentence, command, moved_m, rms_m, change_s)
    sentence = f"good: {np.hypot(moved_m, rms_m) * 1e3:.3f} mm from the stored map"
    return Drift(True, sentence, None, moved_m, rms_m, change_s)


def _only(values: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: values[name] for name in names}
