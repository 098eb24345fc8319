"""Map of the camera and delays of a cell: from calibration files, or typed in the settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from calib.board import Board
from calib.lens import Lens
from calib.plane import PlaneView
from calib.store import CalibrationFileError, StoredCalibration, load
from cell.cable.arrays import FloatArray
from cell.files.input_error import InputError, Problem
from cell.settings.devices import UrArmSettings
from cell.settings.model import Calibration, Settings

#: Radius of the 95 % region of a circular normal law, in standard deviations over both axes.
CIRCLE_95 = 1.73
#: Clocks are set back by less than this, h.
_SET_BACK_H = 0.1


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Map from pixels to the plane, delays and grip, with their uncertainty.

    view       pixel → plane
    latency_s  of the camera's stamps; lag_s of the arm
    map_std_m  standard deviation of the map, over both axes; 0 = not known
    delays_95_s  half widths of the 95 % intervals of latency and lag; None = as typed
    remedy     the command that mends them
    notes      messages for a person
    grip       (4,) gripping point x and y in the frame of the jaw's discs, m; clamp angle against
               them, rad; free length, m; None = as typed
    """

    view: PlaneView
    latency_s: float
    lag_s: float
    map_std_m: float = 0.0
    notes: tuple[str, ...] = ()
    grip: FloatArray | None = None
    delays_95_s: tuple[float, float] | None = None
    remedy: str = ""


def board_of(settings: Settings) -> Board:
    """The board that the settings describe.  Raises ValueError: it is impossible."""
    board = settings.calibration
    if board is None:
        return Board()
    return Board(
        board.columns, board.rows, board.square_m, dictionary=board.dictionary, legacy=board.legacy
    )


def devices_of(settings: Settings) -> Mapping[str, Any]:
    """Devices that a calibration is valid for: camera, picture size, arm, servo setting."""
    camera, arm = settings.camera, settings.arm
    camera_name = getattr(camera, "serial_number", None) or getattr(camera, "device", None)
    return {
        "camera": f"{camera.kind} {camera_name}" if camera_name is not None else camera.kind,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "arm": f"{arm.kind} {arm.host}" if isinstance(arm, UrArmSettings) else arm.kind,
        "lookahead_s": arm.lookahead_s if isinstance(arm, UrArmSettings) else None,
    }


def calibration_file(settings: Settings, kind: str) -> Path:
    """Where a calibration is stored; that of the grip belongs to the product."""
    assert settings.calibration is not None
    of = f".{settings.product}" if kind == "grip" and settings.product is not None else ""
    return settings.calibration.folder / f"{kind}{of}.yaml"


def calibrate_command(settings: Settings, kind: str, config: Path) -> str:
    """The command that makes a calibration."""
    of = f" --product {settings.product}" if kind == "grip" and settings.product else ""
    return f"cell calibrate {kind} --config {config}{of}"


def calibrated(settings: Settings, config: Path, now: datetime | None = None) -> Calibrated:
    """Load and check the calibration that the settings name, or use the typed values.

    config  the settings' file, for messages
    raises  InputError: a calibration is missing, too old, too poor, or one of other devices; each
            with the command that mends it
    """
    if settings.calibration is None:
        return typed(settings)
    now = datetime.now(UTC) if now is None else now
    wanted, folder = settings.calibration, settings.calibration.folder
    problems: list[Problem] = []
    stored: dict[str, StoredCalibration] = {}
    if folder.exists() and not folder.is_dir():
        message = f"{folder}: is a file; give a folder"
        raise InputError.at(config, message, key="calibration.folder") from NotADirectoryError()
    if not any((folder / f"{kind}.yaml").exists() for kind in _NEEDED):
        message = f"this cell is not calibrated yet: {folder} has nothing; run `cell calibrate "
        raise InputError.at(config, f"{message}--config {config}`", key="calibration")
    besides = (k for k in _BESIDES if calibration_file(settings, k).exists())
    for kind in (*_NEEDED, *besides):
        path = calibration_file(settings, kind)
        try:
            stored[kind] = load(path, kind)
            complaint = complaint_of(stored[kind], wanted, settings, now)
        except CalibrationFileError as error:
            command = calibrate_command(settings, kind, config)
            message = str(error).replace(f"cell calibrate {kind}`", f"{command}`")
            problems.append(Problem(config, 1, None, "calibration", message))
            continue
        if complaint is not None:
            remedy = f"run `{calibrate_command(settings, kind, config)}`"
            problems.append(Problem(path, 1, None, kind, f"{complaint}; {remedy}"))
    if problems:
        raise InputError(problems)
    cell, time, grip = stored["cell"], stored["time"], stored.get("grip")
    bound_m = float(cell.error["map_95_m"])
    try:
        return Calibrated(
            view_of_stored(cell),
            time.number("latency_s"),
            time.number("lag_s"),
            bound_m / CIRCLE_95,
            (
                f"calibrated: map ±{bound_m * 1e3:.3f} mm (95 %), {cell.age_h(now) / 24:.1f} days "
                f"old; latency ±{float(time.error['latency_95_s']) * 1e3:.2f} ms, lag "
                f"±{float(time.error['lag_95_s']) * 1e3:.2f} ms, {time.age_h(now):.1f} h old",
                _grip_words(grip, now),
            ),
            None if grip is None else grip_of_stored(grip),
            (float(time.error["latency_95_s"]), float(time.error["lag_95_s"])),
            f"run `cell calibrate time --config {config}`",
        )
    except (CalibrationFileError, KeyError) as error:
        raise InputError.at(folder / "cell.yaml", str(error)) from error


def not_yet_calibrated(settings: Settings, config: Path) -> tuple[str, ...]:
    """Why a cell with these settings must be calibrated before it moves; empty = it need not.

    raises  InputError: a file of the calibration exists, and is no calibration; its folder is none
    """
    try:
        calibrated(settings, config)
    except InputError as error:
        if isinstance(error.__cause__, CalibrationFileError | KeyError | NotADirectoryError):
            raise
        files = {kind: calibration_file(settings, kind) for kind in (*_NEEDED, *_BESIDES)}
        for kind, path in files.items():
            if path.exists():
                try:
                    load(path, kind)
                except CalibrationFileError:
                    raise error from None
        return tuple(map(str, error.problems))
    return ()


def _grip_words(grip: StoredCalibration | None, now: datetime) -> str:
    if grip is None:
        return "uncalibrated: gripping point, clamp angle and free length are as typed"
    return (
        f"calibrated: clamp angle ±{np.degrees(float(grip.error['angle_95_rad'])):.2f}°, free "
        f"length ±{float(grip.error['length_95_m']) * 1e3:.2f} mm (95 %), "
        f"{grip.age_h(now) / 24:.1f} days old"
    )


def typed(settings: Settings) -> Calibrated:
    """Map and lag as typed in the settings, for a cell without calibration."""
    view = settings.camera.view
    assert view is not None  # `check` refuses anything else
    return Calibrated(
        PlaneView.from_scale(view.metres_per_pixel, view.origin_column_px, view.origin_row_px),
        getattr(settings.camera, "latency_s", 0.0),
        settings.arm.lag_s,
        0.0,
        ("uncalibrated: camera.view is typed by hand, nothing says how good it is",),
    )


def as_gripped(settings: Settings, known: Calibrated) -> Settings:
    """Settings with the calibrated free length, and the jaw's discs about the calibrated point."""
    if known.grip is None:
        return settings
    x, y, angle, length_m = known.grip.tolist()
    c, s = np.cos(angle), np.sin(angle)
    discs = (np.array(settings.vision.jaw.discs_m) - [x, y]) @ np.array([[c, -s], [s, c]])
    jaw = settings.vision.jaw.model_copy(update={"discs_m": tuple(map(tuple, discs.tolist()))})
    return settings.model_copy(
        update={
            "cable": settings.cable.model_copy(update={"free_length_m": length_m}),
            "vision": settings.vision.model_copy(update={"jaw": jaw}),
        }
    )


def grip_of_stored(grip: StoredCalibration) -> FloatArray:
    """(4,) of a stored calibration, as in `Calibrated`.  Raises CalibrationFileError."""
    return np.array([*grip.array("point_m", (2,)), *(grip.number(n) for n in _HELD)])


def view_of_stored(cell: StoredCalibration) -> PlaneView:
    """The map of a stored calibration.  Raises CalibrationFileError."""
    return PlaneView(cell.array("homography", (3, 3)), Lens.of(cell.array("lens", (9,))))


def complaint_of(
    stored: StoredCalibration, wanted: Calibration, settings: Settings, now: datetime
) -> str | None:
    """Why a calibration must not be used now; None = it can be used."""
    here = devices_of(settings)
    for name in _HOLDS_FOR[stored.kind]:
        if stored.devices.get(name) != here[name]:
            return f"made with {name} {stored.devices.get(name)}, the settings say {here[name]}"
    limit_h = wanted.time_max_age_h if stored.kind == "time" else 24.0 * wanted.max_age_days
    if stored.age_h(now) < -_SET_BACK_H:  # it would never be too old
        return (
            f"made {-stored.age_h(now):.1f} h after the time that this computer's clock has; set it"
        )
    if stored.age_h(now) > limit_h:
        return f"made {stored.age_h(now):.0f} h ago, at most {limit_h:g} h are allowed"
    for name, limit in bounds_of(wanted).items():
        if name in stored.error and not float(stored.error[name]) <= limit:
            unit = name.rpartition("_")[2]
            return f"{name} = {float(stored.error[name]):.2g} {unit}, at most {limit:g} allowed"
    return None


def bounds_of(wanted: Calibration) -> dict[str, float]:
    """Upper bound of each stated error of a calibration; the unit is in its name."""
    return {
        "map_95_m": wanted.max_error_m,
        "latency_95_s": wanted.max_time_error_s,
        "lag_95_s": wanted.max_time_error_s,
        "point_95_m": wanted.max_grip_error_m,
        "length_95_m": wanted.max_grip_error_m,
        "angle_95_rad": wanted.max_clamp_error_rad,
    }


_HOLDS_FOR = {
    "camera": ("camera", "width_px", "height_px"),
    "cell": ("camera", "width_px", "height_px", "arm"),
    "time": ("camera", "arm", "lookahead_s"),
    "grip": ("camera", "width_px", "height_px", "arm"),
}
#: Required calibrations; others are used if they exist.
_NEEDED, _BESIDES = ("camera", "cell", "time"), ("grip",)
_HELD = ("angle_rad", "length_m")
