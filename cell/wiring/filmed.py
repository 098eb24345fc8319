"""Makes a recording of a film of one's own: the cell plays it, and identifies its cable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from cell.files.input_error import InputError
from cell.records.recording import form
from cell.records.recording.devices import recorded_devices
from cell.records.recording.recorder import Recorder
from cell.records.result import Result
from cell.run.archive import Archive, RecordingSetup
from cell.run.findings import Filming
from cell.run.plans import FILM, filmed
from cell.settings import Settings
from cell.settings.calibrated import calibrated
from cell.settings.records import RecordingSettings
from cell.simulated.filmed import RenderedFilm, filmed_devices
from cell.wiring.build import cell_task, cell_with
from cell.wiring.evidence import PATIENCE_S
from drivers.interfaces import Pose

#: From here an offset can be chosen: so far the hand may be from where insertions begin, m and rad.
NEAR_M, NEAR_RAD = 1e-3, 5e-3


def record_film(
    film: RenderedFilm,
    settings: Settings,
    config: Path,
    target: Path,
    on_step: Callable[[int, str], None] = lambda number, step: None,
) -> Result:
    """Write a recording of a film, with what vision and identification make of it.

    If the hand ends where insertions begin, an offset is chosen too, which nobody executes.

    config   of the settings
    target   file of the recording
    raises   InputError: the calibration is wrong, or the film could not be recorded; OSError
    """
    known = calibrated(settings, config)
    devices = filmed_devices(film, settings, known.lag_s)
    clock = devices.clock
    memory = (settings.recording or RecordingSettings()).memory_mb * 10**6
    recorder = Recorder(devices.arm, clock, memory, PATIENCE_S)
    filming = Filming(film.begin_s, film.rest_s, film.end_s, len(film.frames))
    decides = _near(film.ends_at, cell_task(settings, known).lowered)

    def step(number: int, name: str) -> None:
        if name == FILM:
            clock.sleep_s(max(0.0, film.begin_s - clock.now_s()))
        on_step(number, name)

    with TemporaryDirectory(dir=target.parent) as folder:
        around = recorded_devices(devices, recorder)
        archive = Archive(RecordingSetup(recorder))
        cell = cell_with(settings, around, Path(folder), step, known, archive=archive)
        try:
            result = cell.run_cycle(1, filmed(filming, decides=decides))
        finally:
            cell.close()
        written = Path(result.folder) / form.FILE
        if not written.exists():
            raise InputError.at(target, "was not written: " + "; ".join(cell.notes()))
        written.replace(target)
    return replace(result, folder=str(target))


def _near(pose: Pose, other: Pose) -> bool:
    away_m = float(np.hypot(pose.x_m - other.x_m, pose.y_m - other.y_m))
    return away_m < NEAR_M and abs(pose.angle_rad - other.angle_rad) < NEAR_RAD
