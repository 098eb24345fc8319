"""Converts a film and its gripper poses to a recording, which a cell can replay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from cell.files.input_error import InputError
from cell.files.words import counted
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
from cell.settings.translate import pose_of
from cell.study.folder import read_grip
from cell.wiring.build import PATIENCE_S, cell_task, cell_with
from drivers.files import PICTURES, FilesCamera, video_frames
from drivers.interfaces import CameraError, ConnectError, Devices, Frame, Pose, Trajectory
from drivers.replay import FilmedArm, ReplayCamera, ReplayGripper
from drivers.sim.clock import SimClock

#: Time of a cell that plays a film before the film begins, s.
BEFORE_S = 60.0
#: A gripper within this distance of its last pose is at rest, m and rad.
REST_M, REST_RAD = 0.2e-3, 2e-3
#: A gripper that moves less does not make a cable swing, m.
LEAST_STROKE_M = 2e-3


@dataclass(frozen=True)
class RenderedFilm:
    """A film of a cable, with times and poses on one clock.

    frames  in their order, from index 0
    gripper_log  poses for at least as long
    rest_s  time from which the gripper rests
    """

    frames: tuple[Frame, ...]
    frame_rate_hz: float
    gripper_log: Trajectory
    rest_s: float

    @property
    def begin_s(self) -> float:
        """Time of the first frame."""
        return self.frames[0].t_s

    @property
    def end_s(self) -> float:
        """When the exposure of the next frame would begin."""
        return self.frames[-1].t_s + 1.0 / self.frame_rate_hz

    @property
    def ends_at(self) -> Pose:
        """Where the gripper rests."""
        hand = self.gripper_log
        return Pose(float(hand.x_m[-1]), float(hand.y_m[-1]), float(hand.angle_rad[-1]))


def holds_pictures(folder: Path) -> bool:
    """Whether a folder can be a film."""
    return any(file.suffix.lower() in PICTURES for file in folder.iterdir())


def read_film(
    film: Path, poses: Path, frame_rate_hz: float | None = None, first_frame_s: float = 0.0
) -> RenderedFilm:
    """Read a film and the poses that belong to it.

    film           a folder of pictures, see `drivers.files`, or a video
    poses          CSV: t_s, x_m, y_m, angle_rad
    frame_rate_hz  None = that of `frames.csv` or the video
    first_frame_s  added to the film's times: when its first frame was exposed, on the poses' clock
    raises         InputError: a file cannot be read, or the two do not belong together
    """
    motion = read_grip(poses)
    hand = Trajectory(motion.t_s, motion.x_m, motion.y_m, motion.angle_rad)
    try:
        rate_hz, frames = _frames(film, frame_rate_hz)
    except (ConnectError, CameraError) as error:
        raise InputError.at(film, f"{error.cause}; {error.remedy}".rstrip("; ")) from error
    if len(frames) < 2:
        raise InputError.at(
            film, f"holds {counted(len(frames), 'frame')}; needs a second of a swing"
        )
    if len({frame.image.shape for frame in frames}) > 1:
        raise InputError.at(film, "its pictures differ in size; give those of one film")
    frames = [replace(frame, t_s=frame.t_s + first_frame_s) for frame in frames]
    begin_s, end_s = frames[0].t_s, frames[-1].t_s
    if hand.t_s[0] > begin_s or hand.t_s[-1] < end_s:
        raise InputError.at(
            poses,
            f"spans {hand.t_s[0]:g} … {hand.t_s[-1]:g} s, the film {begin_s:g} … {end_s:g} s; "
            "log the gripper for as long as is filmed, and say with --first-frame when the first "
            "frame was exposed on the clock of the poses",
        )
    rest_s = _rests_from(poses, hand, begin_s)
    if end_s - rest_s < 0.1:
        raise InputError.at(
            film, f"ends {end_s - rest_s:.2f} s after the gripper rests; film a second of the swing"
        )
    return RenderedFilm(tuple(frames), rate_hz, hand, rest_s)


def filmed_devices(film: RenderedFilm, settings: Settings, lag_s: float) -> Devices:
    """Devices that play a film once, on a clock that begins before it.

    lag_s  of the arm that would insert the cable: a choice depends on it
    """
    clock = SimClock(film.begin_s - BEFORE_S)
    home = pose_of(settings.motion.home)
    return Devices(
        FilmedArm(clock, home, settings.arm.rate_hz, lag_s, film.gripper_log),
        ReplayCamera(clock, film.frame_rate_hz, film.frames),
        ReplayGripper(clock, holds=True),
        clock,
    )


def _frames(film: Path, frame_rate_hz: float | None) -> tuple[float, list[Frame]]:
    if not film.exists():
        raise ConnectError("camera", "is missing", "give a video or a folder of pictures")
    if film.is_file():
        return video_frames(film, frame_rate_hz)
    camera = FilesCamera(film, frame_rate_hz)
    camera.connect()
    camera.start(camera.remaining)
    frames = []
    while (frame := camera.read()) is not None:
        frames.append(frame)
    return camera.frame_rate_hz, frames


def _rests_from(poses: Path, hand: Trajectory, begin_s: float) -> float:
    """Time from which the gripper rests.  Raises InputError: it never moves in the film."""
    away_m = np.hypot(hand.x_m - hand.x_m[-1], hand.y_m - hand.y_m[-1])
    turned = np.abs(hand.angle_rad - hand.angle_rad[-1])
    filmed = hand.t_s >= begin_s
    if away_m[filmed].max() < LEAST_STROKE_M and turned[filmed].max() < LEAST_STROKE_M / 0.1:
        raise InputError.at(
            poses,
            f"the gripper moves by {1e3 * away_m[filmed].max():.2g} mm in the film; a cable that "
            "does "
            "not swing cannot be identified",
        )
    moving = np.flatnonzero((away_m > REST_M) | (turned > REST_RAD))
    return float(hand.t_s[min(moving[-1] + 1, len(hand.t_s) - 1)])


#: Largest distance of the gripper from the start of insertions at which an offset is chosen, m and
#: rad.
NEAR_M, NEAR_RAD = 1e-3, 5e-3


def record_film(
    film: RenderedFilm,
    settings: Settings,
    config: Path,
    target: Path,
    on_step: Callable[[int, str], None] = lambda number, step: None,
) -> Result:
    """Write a recording of a film, with the results of vision and identification.

    If the gripper ends where insertions begin, an offset is chosen too, but not executed.

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
    ends, begins = film.ends_at, cell_task(settings, known).lowered
    away_m = float(np.hypot(ends.x_m - begins.x_m, ends.y_m - begins.y_m))
    decides = away_m < NEAR_M and abs(ends.angle_rad - begins.angle_rad) < NEAR_RAD

    def step(number: int, name: str) -> None:
        if name == FILM:
            clock.sleep_s(max(0.0, film.begin_s - clock.now_s()))
        on_step(number, name)

    with TemporaryDirectory(dir=target.parent) as folder:
        around = recorded_devices(devices, recorder)
        archive = Archive(RecordingSetup(recorder, wanted=RecordingSettings(whole_frames=True)))
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
