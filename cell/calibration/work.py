"""Calibrations from start to end, part by part: from devices or folders to files and reports."""

from __future__ import annotations

import contextlib
import logging
import shutil
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from calib.cell import CellFit
from calib.errors import CalibrationError
from calib.plane import PlaneView
from calib.store import CalibrationFileError, StoredCalibration, load, save
from calib.timing import Delay
from cell.calibration import conclude, grip, measure, raw
from cell.calibration.assistants import BOARD_VIEWS, Assistant, OnCoverage, Operator
from cell.calibration.conclude import Drift
from cell.calibration.measure import Say
from cell.calibration.report import camera_report, cell_report, grip_report, time_report
from cell.calibration.session import CalibrationSession, opened
from cell.files.atomic import write_atomic
from cell.files.input_error import InputError, Problem
from cell.files.overwriting import check_output
from cell.files.rescue import remedy, write_or_rescue
from cell.settings import Settings
from cell.settings.calibrated import (
    Calibrated,
    board_of,
    bounds_of,
    calibration_file,
    typed,
    view_of_stored,
)
from cell.settings.translate import vision_of
from cell.wiring.build import staged_devices
from drivers.emulators.launch import EmulatorError
from drivers.interfaces import DeviceError

_LOG = logging.getLogger(__name__)

#: Remedies for a calibration with too large an uncertainty.
_BETTER = {
    "camera": "show the board in all corners of the picture, tilted to all sides",
    "cell": "widen `limits`, show a plumb line at two places if there was none, see the reports of "
    "camera and cell for what is uncertain",
    "time": "let the motion be brisk, light the marks better",
    "grip": "light the cable better, let limits.angle_rad reach further, so that it hangs",
}


class BrokenOffError(ValueError):
    """The current part of a calibration failed; nothing of it is stored.

    A device failed, the pictures cannot be used, or a stored calibration cannot be read.
    Scenario: the camera's cable is pulled out while the board is shown.
    """


class CalibrationJob:
    """A calibration run, used as a context: its devices, settings and files.

    say, ask  reports progress to a person; asks a question and waits for the answer
    look      called with every picture of the board; None = not called
    """

    def __init__(
        self,
        settings: Settings,
        config: Path,
        seed: int,
        say: Say,
        ask: Callable[[str], str],
        look: OnCoverage | None = None,
    ) -> None:
        if settings.calibration is None:
            message = "is missing; add `calibration: {}`, and leave out camera.view"
            raise InputError([Problem(config, 1, None, "calibration", message)])
        self._settings, self._config, self._seed = settings, config, seed
        self._say, self._ask, self._look = say, ask, look
        self._folder = settings.calibration.folder
        try:
            self._board = board_of(settings)
        except ValueError as error:
            raise InputError.at(config, str(error), key="calibration") from error
        self._stack = contextlib.ExitStack()
        self._session: CalibrationSession | None = None
        self._assistant: Assistant = Operator(ask)
        self._made: dict[str, StoredCalibration] = {}
        self._reports: dict[str, Path] = {}
        self._unwritten: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Release the devices.  Raises BrokenOffError: the current part failed."""
        self._stack.__exit__(kind, error, trace)
        if isinstance(error, DeviceError | EmulatorError | CalibrationError | CalibrationFileError):
            raise BrokenOffError(str(error)) from error

    # --- parts --------------------------------------------------------------------------------

    def check_files(self, *parts: str) -> None:
        """Check that the results can be written, before a motion.  Raises InputError."""
        for file in (calibration_file(self._settings, part) for part in parts):
            for path in (file, file.with_suffix(".html")):
                try:
                    check_output(path, force=True)
                except ValueError as error:
                    raise InputError.at(
                        self._config, str(error), key="calibration.folder"
                    ) from error

    def do(self, part: str, source: Path | None = None) -> StoredCalibration | None:
        """Calibrate `camera`, `cell`, `time` or `grip`, live or from a folder.

        returns  None = it is omitted: nobody has a cable, or its grip is too uncertain
        raises  CalibrationError, CalibrationFileError, InputError; a device error ends the job
        """
        self._say(f"--- {part}")
        parts: dict[str, Callable[[Path | None], StoredCalibration | None]] = {
            "camera": self._camera,
            "cell": self._cell,
            "time": self._time,
            "grip": self._grip,
        }
        made = parts[part](source)
        if made is None:
            self._say(f"{part} is left out: what is typed holds, or what was calibrated before")
            return None
        self._made[part] = made
        path = calibration_file(self._settings, part)
        _LOG.info("%s: %s, for %s", part, _words(made), path)
        self._keep(path, lambda place: save(place, made))
        return made

    def _camera(self, source: Path | None) -> StoredCalibration:
        if source is None:
            session = self._open()
            pictures = measure.show_board(
                session, self._assistant, self._board, self._say, self._look
            )
            self._record("camera", partial(raw.save_pictures, pictures=pictures))
        else:
            pictures = list(raw.read_pictures(source))
            self._check_taken(source, pictures)
        fit, views, troubles = conclude.camera_from(pictures, self._board)
        for trouble in troubles:
            self._say(trouble)
        stored = conclude.stored_camera(fit, self._settings)
        self._report("camera", camera_report(stored, fit, views, pictures, troubles))
        return stored

    def _cell(self, source: Path | None) -> StoredCalibration:
        camera = self._before("camera")
        self._check_size(camera)
        if source is None:
            shown = measure.film_plate(
                self._open(),
                self._assistant,
                lambda some: self._first_fit(some, camera),
                self._say,
            )
            self._record("cell", partial(raw.save_cell, shown=shown))
        else:
            shown = raw.read_cell(source)
            self._check_taken(source, [one.picture for one in shown.poses])
        fit = conclude.cell_from(shown, camera, self._settings)
        for sentence in fit.left_out:
            self._say(sentence)
        classic_m = conclude.disagreement_m(fit, shown, camera, self._settings)
        stored = conclude.stored_cell(fit, classic_m, self._settings)
        self._report("cell", cell_report(stored, fit, shown, classic_m, self._settings))
        return stored

    def _first_fit(self, some: raw.ShownCell, camera: StoredCalibration) -> CellFit:
        """The fit of the first poses, which are saved if it is refused."""
        try:
            return conclude.cell_from(some, camera, self._settings)
        except CalibrationError:
            if folder := self._record("cell", partial(raw.save_cell, shown=some)):
                self._say(f"{len(some.poses)} poses are kept in {folder}, for --from")
            raise

    def _time(self, source: Path | None) -> StoredCalibration:
        corrected_s = 0.0
        if source is None:
            move = self._move(view_of_stored(self._before("cell")))
            self._record("time", partial(raw.save_move, move=move))
        else:
            move = raw.read_move(source)
        times = conclude.times_from(move)
        stored = conclude.stored_times(times, self._settings, len(move.stamps_s), corrected_s)
        self._report("time", time_report(stored, times, move))
        return stored

    def _grip(self, source: Path | None) -> StoredCalibration | None:
        cell = self._before("cell")
        self._check_size(cell)
        view = view_of_stored(cell)
        if source is None:
            shown = grip.show_cable(self._open(), self._assistant, view, self._say)
            if shown is None:
                return None
            self._record("grip", partial(raw.save_cell, shown=shown))
        else:
            shown = raw.read_cell(source)
            self._check_taken(source, [one.picture for one in shown.poses])
        views, troubles = grip.views_of(shown, view, self._settings)
        fit = grip.grip_from(views, cell)
        stored = grip.stored_grip(fit, self._settings, troubles)
        self._report("grip", grip_report(stored, fit, views, shown, view))
        poor = self._too_poor(stored)
        for line in poor:  # the cell can do without, with what is typed
            self._say(line)
        return None if poor else stored

    def check(self) -> Drift:
        """Drift of the cell since its stored calibration.  Raises as `do`."""
        cell = self._before("cell")
        latency_s = self._before("time").number("latency_s")
        session = self._open()
        poses = []
        for k, goal in enumerate(measure.first_poses(self._settings)[::2]):
            rest = session.rest_at(goal)
            poses.append(raw.ShownPose("fit", rest.pose, raw.NamedImage(f"{k}", rest.image)))
        shown = raw.ShownCell(tuple(poses))
        drift = conclude.today(shown, cell, None, self._settings, str(self._config))
        if not drift.good:
            return drift
        move = self._move(view_of_stored(cell))
        times = conclude.times_from(move)
        changes = conclude.Times(
            Delay(times.latency.value_s - latency_s, 0.0, times.latency.rms_m), times.lag
        )
        return conclude.today(shown, cell, changes, self._settings, str(self._config))

    # --- results ------------------------------------------------------------------------------

    def shortcomings(self) -> list[str]:
        """Reasons why `cell run` would refuse the results, or lacks them, each with its remedy;
        empty = they are good and written.
        """
        poor = [line for made in self._made.values() for line in self._too_poor(made)]
        return [*self._unwritten, *poor]

    def _too_poor(self, made: StoredCalibration) -> list[str]:
        limits = self._settings.calibration
        assert limits is not None
        return [
            f"{made.kind}: {name} = {made.error[name]:.2g}, at most {bound:g} allowed; "
            f"{_BETTER[made.kind]}, then run `cell calibrate --config {self._config}`"
            for name, bound in bounds_of(limits).items()
            if name in made.error and not made.error[name] <= bound
        ]

    def summary(self) -> dict[str, Any]:
        """All results, for programs."""
        return {
            kind: {
                "file": str(calibration_file(self._settings, kind)),
                "report": str(self._reports[kind]),
                "error": {k: v if np.isfinite(v) else None for k, v in made.error.items()},
                "result": {k: np.asarray(v).tolist() for k, v in made.result.items()},
            }
            for kind, made in self._made.items()
        }

    def lines(self) -> list[str]:
        """All results, for people."""
        lines = []
        for kind, made in self._made.items():
            lines.append(f"{kind:7} {_words(made)}")
            path = calibration_file(self._settings, kind)
            lines.append(f"        {path}, {self._reports[kind]}")
        return lines

    # --- devices and files --------------------------------------------------------------------

    def _open(self) -> CalibrationSession:
        if self._session is not None:
            return self._session
        settings = self._settings
        nothing = Calibrated(PlaneView(np.eye(3)), 0.0, settings.arm.lag_s)
        known = nothing if settings.camera.view is None else typed(settings)
        devices, assistant = self._stack.enter_context(
            staged_devices(settings, self._config, known, self._seed, BOARD_VIEWS)
        )
        if assistant is not None:
            self._assistant = assistant
        self._session = self._stack.enter_context(
            opened(settings, devices, moves=True, say=self._say)
        )
        return self._session

    def _move(self, view: PlaneView) -> raw.DetectedMove:
        session = self._open()
        session.go_to(session.home)
        path = measure.timing_path(self._settings, session.home, session.devices.arm.rate_hz)
        self._say("film a motion")
        filmed = session.film(path)
        self._say(f"look at {len(filmed.frames)} frames")
        return measure.detect_move(filmed, view, vision_of(self._settings).marks)

    def _before(self, kind: str) -> StoredCalibration:
        """A calibration that this one needs."""
        if kind in self._made:
            return self._made[kind]
        return load(calibration_file(self._settings, kind), kind)

    def _check_size(self, before: StoredCalibration) -> None:
        size = (self._settings.camera.width_px, self._settings.camera.height_px)
        made = (before.devices.get("width_px"), before.devices.get("height_px"))
        if made != size:
            raise CalibrationError(
                f"{before.kind} was calibrated with pictures of {made[0]} × {made[1]}, the "
                f"settings say {size[0]} × {size[1]}",
                f"run `cell calibrate {before.kind} --config {self._config}`",
            )

    def _check_taken(self, folder: Path, pictures: Sequence[raw.NamedImage]) -> None:
        """Raises InputError: pictures of a folder are not of the settings' camera."""
        width, height = self._settings.camera.width_px, self._settings.camera.height_px
        for picture in pictures:
            rows, columns = picture.image.shape
            if (columns, rows) != (width, height):
                message = (
                    f"has {columns} × {rows} pixels, the camera of {self._config} {width} × "
                    f"{height}; give pictures as the camera takes them"
                )
                raise InputError.at(folder / picture.name, message)

    def _record(self, kind: str, save: Callable[[Path], None]) -> Path | None:
        """Save the measurements in a new folder; None = that failed, which is reported."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        folder = self._folder / "recorded" / f"{kind}-{stamp}"
        try:
            save(folder)
        except OSError as error:
            shutil.rmtree(folder, ignore_errors=True)
            why = f"{error.strerror or error}; {remedy(error)}"
            self._say(f"{folder}: what was measured cannot be kept: {why}")
            return None
        return folder

    def _report(self, kind: str, page: str) -> None:
        path = calibration_file(self._settings, kind).with_suffix(".html")
        self._reports[kind] = path
        self._keep(path, lambda place: write_atomic(place, page))

    def _keep(self, path: Path, write: Callable[[Path], None]) -> None:
        """Write a file of a result; a failure becomes one of the shortcomings."""
        if trouble := write_or_rescue(path, write):
            self._unwritten.append(trouble)


def _words(made: StoredCalibration) -> str:
    e = made.error
    match made.kind:
        case "camera":
            return (
                f"lens ±{e['spread_95_px']:.3f} px (95 %), corners {e['noise_px']:.3f} px, "
                f"halves differ by {e['halves_rms_px']:.3f} px"
            )
        case "cell":
            judged = "no pose was held out to judge it"
            if np.isfinite(e["held_out_rms_m"]):
                rms, worst = (f"{e[f'held_out_{k}_m'] * 1e3:.3f} mm" for k in ("rms", "max"))
                judged = f"held-out poses {rms} rms, {worst} worst"
            return f"map ±{e['map_95_m'] * 1e3:.3f} mm (95 %, worst of the picture), {judged}"
        case "grip":
            return (
                f"clamp angle {np.degrees(made.number('angle_rad')):+z.2f} ± "
                f"{np.degrees(e['angle_95_rad']):.2f}°, free length "
                f"{made.number('length_m') * 1e3:.2f} ± {e['length_95_m'] * 1e3:.2f} mm, gripping "
                f"point ±{e['point_95_m'] * 1e3:.3f} mm (95 %)"
            )
    return (
        f"latency {made.number('latency_s') * 1e3:.2f} ± {e['latency_95_s'] * 1e3:.2f} ms, lag "
        f"{made.number('lag_s') * 1e3:.2f} ± {e['lag_95_s'] * 1e3:.2f} ms (95 %)"
    )
